"""The script and cron's line of docs/operations, night after night: exit codes, log, mails, and `status`."""

import fcntl
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from flexroad.pipeline.run.summary import read_summary

OPERATIONS = Path(__file__).parent.parent / "docs" / "operations"
SCRIPT = OPERATIONS / "flexroad-nightly.sh"
CRON = OPERATIONS / "flexroad.cron"
INSTALLED = "/usr/local/bin/flexroad-nightly"
CALLED = '"{0}/nightly"; code=$?; echo $code > "{0}/code"; exit $code'
"""What the line for cron calls: the script, with a note of its exit code."""
COMMAND = 'exec "{}" -c "from flexroad.pipeline.cli.main import main; main()" "$@"'
WORDS = {"--roads 'roads/*.gpkg'": "--road-mask 'road_mask/*.tif' --tile-size 60"}
LOST = "2 files skipped by the catalog, 1 tile lost"
SKIPPED = "(dsm): not a raster that GDAL can read"
REPAIR = "repair what was skipped, repeat the `flexroad catalog` command, then `flexroad run`"


def program(path: Path, text: str) -> None:
    path.write_text(f"#!/bin/bash\n{text}\n")
    path.chmod(0o755)


class Machine:
    """A folder with a survey, and the script as an operator has copied and edited it."""

    def __init__(self, folder: Path, survey: Path) -> None:
        self.folder, self.run = folder, folder / "runs" / "city"
        shutil.copytree(survey, folder / "survey")
        self.dsm = folder / "survey" / "dsm"
        self.files = sorted(path.name for path in self.dsm.iterdir())
        self.kept = shutil.copytree(self.dsm, folder / "kept")
        (folder / "bin").mkdir()
        program(folder / "bin" / "flexroad", COMMAND.format(sys.executable))
        text = SCRIPT.read_text()
        edits = {"/srv/flexroad": str(folder), "/opt/flexroad/bin": str(folder / "bin"), **WORDS}
        for place, edited in edits.items():
            assert place in text
            text = text.replace(place, edited)
        program(folder / "nightly", text.removeprefix("#!/bin/bash\n"))
        program(folder / "called", CALLED.format(folder))
        *_, line = CRON.read_text().splitlines()
        command = line.split(maxsplit=6)[6]
        assert INSTALLED in command
        self.command = command.replace(INSTALLED, f"'{folder}/called'").replace("/srv/flexroad", str(folder))

    def repair(self, name: str) -> None:
        shutil.copy2(self.kept / name, self.dsm / name)

    def damage(self, name: str) -> None:
        (self.dsm / name).write_bytes((self.kept / name).read_bytes()[:200])

    def night(self) -> tuple[int, str, str]:
        """The exit code of a night, what it adds to the log, and its mail."""
        log = self.folder / "runs" / "city.log"
        before = log.read_text() if log.exists() else ""
        # What it prints, cron would mail.
        done = subprocess.run(["sh", "-c", self.command], capture_output=True, check=False, text=True)
        code = int((self.folder / "code").read_text())
        return code, log.read_text()[len(before) :], done.stdout + done.stderr

    def status(self) -> str:
        words = [self.folder / "bin" / "flexroad", "status", self.run]
        return subprocess.run(words, capture_output=True, check=True, text=True).stdout


@pytest.fixture
def machine(made_survey, tmp_path):
    return Machine(tmp_path / "flexroad", made_survey)


@pytest.mark.slow
def test_nights_with_new_damaged_and_repaired_files_say_what_happened(machine):
    old, _, new, late = machine.files
    tile = old.removesuffix(".tif")
    for name in (new, late):
        (machine.dsm / name).unlink()

    code, log, mail = machine.night()
    assert (code, mail) == (0, "")
    assert "2 tiles: 2 done (0 cached), 0 failed, 0 pending; 2 new, 0 changed, 0 vanished; " in log

    machine.repair(new)
    machine.damage(late)
    machine.damage(old)
    code, log, mail = machine.night()
    assert code == 1
    first = f"2 tiles: 2 done (0 cached), 0 failed, 0 pending; 1 new, 1 changed, 0 vanished; {LOST}; "
    line = f"skipped dsm/{old}, dsm/{late} {SKIPPED}"
    told = f"{line}; the run lost 1 tile with that: {tile}"
    assert f"warning: {line}\n" in log
    assert first in log
    assert f"warning: {told}\n" in log
    assert f"the catalog lacks 2 files; next: {REPAIR}\n" in log
    assert first in mail
    status = machine.status()
    assert status.startswith(first)
    assert f"  {told}; {REPAIR}\n" in status
    summary = read_summary(machine.run)
    names = ("done", "failed", "new", "changed", "vanished", "skipped", "lost", "exit_code", "left_out")
    assert [summary[name] for name in names] == [2, 0, 1, 1, 0, 2, 1, 1, [told]]

    # Nothing was repaired, and nothing is forgotten.
    subprocess.run([machine.folder / "bin" / "flexroad", "clean", machine.run], check=True)
    assert (machine.run / "tiles" / tile / "item.json").exists()
    code, log, mail = machine.night()
    assert code == 1
    again = f"2 tiles: 2 done (2 cached), 0 failed, 0 pending; 0 new, 0 changed, 0 vanished; {LOST}; "
    assert again in log
    assert again in mail
    assert f"warning: {told}\n" in log

    machine.repair(old)
    machine.repair(late)
    code, log, mail = machine.night()
    assert (code, mail) == (0, "")
    assert "4 tiles: 4 done (0 cached), 0 failed, 0 pending; 1 new, 3 changed, 0 vanished; " in log
    assert "skipped" not in log + machine.status()

    # A tile that left the area is another thing.
    (machine.dsm / old).unlink()
    code, log, mail = machine.night()
    assert (code, mail) == (0, "")
    assert "3 tiles: 3 done (0 cached), 0 failed, 0 pending; 0 new, 3 changed, 1 vanished; " in log


@pytest.mark.slow
def test_night_that_cannot_start_ends_with_2_and_a_mail(machine):
    (machine.folder / "runs").mkdir()
    with (machine.folder / "runs" / "city.lock").open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        code, log, mail = machine.night()
    assert code == 2
    assert "the command of an earlier night is still at work" in log
    assert mail.endswith("the command of an earlier night is still at work\n")
    (machine.folder / "survey").rename(machine.folder / "unmounted")
    code, log, mail = machine.night()
    assert code == 2
    assert "error: " in log
    assert "error: " in mail
    assert mail.endswith("the catalog could not be made\n")
    assert not machine.run.exists()
