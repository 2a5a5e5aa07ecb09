"""A hundred nightly runs over a survey that changes: the run then equals a run from scratch.

``FLEXROAD_NIGHTS_SEED=7`` plays other nights. What happens in a night depends on the seed and its number, so
that ``FLEXROAD_NIGHTS=12,40,41`` plays only some of them, to find the shortest sequence that fails.
"""

import contextlib
import json
import os
import shutil
import signal
from collections.abc import Collection, Iterator
from pathlib import Path
from random import Random
from unittest import mock

import pytest
import yaml

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.store.records import load_checked
from flexroad.tasks.segment import mask
from tests import command_line
from tests.faulty_files import FAULTS, Faulty, Observer, intercepted
from tests.permissions import permissions_enforced
from tests.soak.survey import ANCHOR, CONFIG, Survey, damage
from tests.whole_run import rows, temporary_files

pytestmark = [pytest.mark.slow, pytest.mark.soak("runs")]

SEED = os.environ.get("FLEXROAD_NIGHTS_SEED", "1")
CHOSEN = [int(night) for night in os.environ.get("FLEXROAD_NIGHTS", "").split(",") if night]
NIGHTS = 100
COMPARED, COMPLETELY = 2, 10
"""After so many nights the tiles that changes concern are computed from scratch, and all of them."""
STAGES = ("load", "segment", "ecsrc", "fit", "sample", "evaluate", "assess", "export")
STOPS = FAULTS | {"interrupted": lambda at: Faulty(at, lambda: os.kill(os.getpid(), signal.SIGINT))}
OPERATIONS = 600
"""Operations on files of a run, of which one stops it."""
LEFT_ALONE = {"config.yaml", "run.json", "catalog.parquet", "failures.csv", "lock.json"}
"""Files that are not damaged: they have no checksum, or without them there is no run."""

Outcome = dict[str, str | bytes]
"""Rows, failures, item and products of a tile, by name."""


@contextlib.contextmanager
def program(version: int) -> Iterator[None]:
    """Use a version of the program: the roads of version 1 lack every seventh row."""
    first = mask.segment

    def segment(data, options):
        road = first(data, options)
        road.mask[::7] = False
        return road

    with contextlib.ExitStack() as stack:
        if version:
            stack.enter_context(mock.patch.object(mask, "VERSION", mask.VERSION + version))
            stack.enter_context(mock.patch.object(mask, "segment", segment))
        yield


class Nights:
    """A survey, its run, and what each tile of the run has to be."""

    def __init__(self, folder: Path) -> None:
        self.told: list[str] = []
        """What has happened, one line for each night."""
        self.said = ""
        """What the last command has printed."""
        self._folder, self._out, self._survey = folder, folder / "run", Survey(folder)
        self._random = Random()
        self._expected: dict[str, Outcome] = {}
        self._concerned: set[str] = set()
        """Tiles that changes concern since the last comparison."""
        self._hidden: Path | None = None
        """A file that cannot be read this night."""
        (folder / "config.yaml").write_text(yaml.safe_dump(CONFIG, sort_keys=False))
        # What is imported and compiled here need not be in each process.
        self._survey.catalog.write(folder / "catalog.parquet")
        command_line.call(*self._run(), "--tile", ANCHOR, "--out", folder / "first").expected(0)

    def play(self, night: int) -> None:
        """Change the survey, bring the run up to date, and compare it."""
        self._random = random = Random(f"{SEED} {night}")
        self.told.append(f"{night}:")
        for _ in range(random.choice((1, 1, 2))):
            self._note(*self._survey.change(random))
        if random.random() < 0.2:
            self._hide()
        self._survey.catalog.write(self._folder / "catalog.parquet")
        with program(self._survey.program):
            if random.random() < 0.5:
                acts = (self._stop, self._part, self._rerun, self._meanwhile, self._unmount, self._clean)
                random.choice((*acts, self._damage))()
            # Only --verify finds damage of products that keep their size.
            code = self._command(*self._run(), "--verify")
            if random.random() < 0.1:
                code = self._command(*self._again(), "--from", random.choice(STAGES))
            excused = self._show()
            if CHOSEN or night % COMPARED == 0:
                self._compare(code, excused, completely=night % COMPLETELY == 0)
            self._concerned |= excused

    def _note(self, text: str, concerned: Collection[str] = ()) -> None:
        self.told[-1] += f" {text};"
        self._concerned.update(concerned)

    def _hide(self) -> None:
        """Write a file that cannot be read this night, and can be the next one: of the same size and time."""
        text, concerned = self._survey.edit(self._random)
        self._hidden = self._survey.folder / text.split()[0]
        self._hidden.chmod(0)
        self._note(f"{text}, not readable", concerned)

    def _show(self) -> set[str]:
        """Make the file readable again; return the tiles that it concerns: they may have failed."""
        if not self._hidden:
            return set()
        self._hidden.chmod(0o644)
        concerned, self._hidden = self._survey.around(self._hidden.name), None
        return concerned

    # Commands

    def _run(self) -> list:
        files = ["--config", self._folder / "config.yaml", "--catalog", self._folder / "catalog.parquet"]
        return ["run", "--out", self._out, *files, *self._survey.options, "--executor", "serial"]

    def _again(self) -> list:
        return ["rerun", self._out, "--executor", "serial"]

    def _command(self, *words, observer: Observer = lambda operation: None) -> int:
        """Run a command in a copy of this process: no night has the open files of another one."""

        def call() -> int:
            with permissions_enforced(), intercepted(self._out, observer):
                said = command_line.call(*words)
            printed.write_text(said.out + said.err)
            return said.code

        printed = self._folder / "printed.txt"
        printed.write_text("")
        code, self.said = command_line.forked(call), printed.read_text()
        self._note(f"{words[0]} gives {code}")
        assert code != command_line.RAISED
        return code

    # What may happen before the run that is compared

    def _stop(self) -> None:
        """Run until an error on a file, Ctrl-C or a kill."""
        kind, at = self._random.choice(sorted(STOPS)), self._random.randrange(OPERATIONS)
        self._note(f"{kind} at {at}")
        self._command(*self._run(), observer=STOPS[kind](at))

    def _part(self) -> None:
        """Run some tiles."""
        ids = self._random.sample([tile.id for tile in self._survey.catalog.tiles], 3)
        self._command(*self._run(), "--tile", *ids)

    def _rerun(self) -> None:
        """Run tiles that failed, some tiles from a stage on, or all."""
        some = ["--from", self._random.choice(STAGES), "--tile", "10", "11"]
        self._command(*self._again(), *self._random.choice((["--failed"], some, [])))

    def _meanwhile(self) -> None:
        """Change a file while it is processed."""
        path = self._survey.folder / self._random.choice(self._survey.files)
        if path == self._hidden:
            return
        before = _content(path)
        text, concerned = self._survey.edit(self._random, path.relative_to(self._survey.folder).as_posix())
        after, at = _content(path), self._random.randrange(OPERATIONS)
        _put(path, before)
        self._note(f"{text}, at {at}", concerned)
        self._command(*self._run(), observer=Faulty(at, lambda: _put(path, after)))
        _put(path, after)

    def _unmount(self) -> None:
        """Run while the survey is missing."""
        away = self._survey.folder.rename(self._folder / "away")
        self._note("survey missing")
        self._command(*self._run())
        away.rename(self._survey.folder)

    def _clean(self) -> None:
        self._command("clean", self._out)

    def _damage(self) -> None:
        """Damage files of the run."""
        pattern = self._random.choice(("database.txt", "*.*", "tiles/*/*", "store/*/*/*"))
        files = [path for path in self._out.glob(pattern) if path.is_file() and path.name not in LEFT_ALONE]
        for path in self._random.sample(sorted(files), min(len(files), 5)):
            self._note(f"{path.relative_to(self._out)} {damage(path, self._random)}")

    # Comparison

    def _compare(self, code: int, excused: set[str], completely: bool) -> None:
        """Compare the run with one from scratch, of the tiles that changes concern or of all.

        Tiles that are excused may have failed.
        """
        catalog = Catalog.read(self._folder / "catalog.parquet")
        ids = {tile.id for tile in catalog.tiles}
        chosen = ids if completely else self._concerned & ids | (ids - self._expected.keys())
        scratch = self._folder / "scratch" / "run"
        shutil.rmtree(scratch.parent, ignore_errors=True)

        def compute() -> int:
            config = load_config(self._folder / "config.yaml", self._survey.options[1::2])
            run_tiles(Run.create(scratch, config, catalog), SerialExecutor(), lambda tile: tile.id in chosen)
            return 0

        assert command_line.forked(compute) == 0
        self._expected |= outcomes(scratch, chosen)
        self._concerned.clear()
        found = outcomes(self._out, ids)
        failed = {tile for tile in ids if found[tile]["failures"]}
        compared = sorted(ids - (failed & excused))
        wrong = [line for tile in compared for line in differences(tile, found[tile], self._expected[tile])]
        assert not wrong, "\n".join(wrong)
        assert code == bool(failed)
        assert not (self._out / "lock.json").exists()
        if completely and not excused:
            self._compare_folders(scratch, bool(failed))

    def _compare_folders(self, scratch: Path, failed: bool) -> None:
        """Compare what a run has after `flexroad clean` with what a run from scratch has."""
        before = _names(self._out)
        self._clean()
        after, needed = _names(self._out), _names(scratch)
        assert not needed & before - after
        assert failed or after <= needed
        assert not temporary_files(self._out)
        for path in (scratch / "collection.json", *scratch.glob("*.vrt")):
            assert (self._out / path.name).read_bytes() == path.read_bytes(), path.name


def outcomes(out: Path, tiles: Collection[str]) -> dict[str, Outcome]:
    """Return what a run gives for each of these tiles, without times."""
    table, failures = rows(out), (out / "failures.csv").read_text().splitlines()
    found: dict[str, Outcome] = {}
    for tile in tiles:
        lines = [line for line in failures if line.startswith(f"{tile},")]
        found[tile] = {
            "rows": table[table["tile_id"] == tile].to_csv(index=False),
            "failures": "\n".join(lines),
        }
        if not lines:
            folder = out / "tiles" / tile
            item = load_checked((folder / "item.json").read_bytes())
            for part in (item["properties"], *item["properties"]["flexroad:rows"]):
                for name in {"created", "flexroad:seconds", "seconds"} & part.keys():
                    del part[name]
            found[tile]["item"] = json.dumps(item, indent=1)
            found[tile] |= {name: (folder / name).read_bytes() for name in _products(item)}
    return found


def _products(item: dict) -> list[str]:
    return [asset["href"] for asset in item["assets"].values()]


def differences(tile: str, found: Outcome, expected: Outcome) -> Iterator[str]:
    """Yield the parts of a tile's outcome that differ, with the first line that does."""
    for name in sorted(found.keys() | expected.keys()):
        one, other = found.get(name), expected.get(name)
        if one != other:
            texts = isinstance(one, str) and isinstance(other, str)
            lines = zip(one.splitlines(), other.splitlines(), strict=False) if texts else ()
            yield f"{tile} {name}: " + next((f"{a} instead of {b}" for a, b in lines if a != b), "")


def _names(out: Path) -> set[str]:
    """Return the names of the artefacts and products of a run."""
    paths = (*out.glob("store/*/*/*"), *out.glob("tiles/*/*"))
    return {path.relative_to(out).as_posix() for path in paths}


def _content(path: Path) -> tuple[bytes, int] | None:
    """Return the content and the time of a file, None if it is missing."""
    return (path.read_bytes(), path.stat().st_mtime_ns) if path.exists() else None


def _put(path: Path, content: tuple[bytes, int] | None) -> None:
    """Give a file a content and a time."""
    if content is None:
        path.unlink(missing_ok=True)
        return
    path.write_bytes(content[0])
    os.utime(path, ns=(content[1], content[1]))


def test_hundred_nights_equal_runs_from_scratch(tmp_path):
    nights = Nights(tmp_path)
    for night in CHOSEN or range(1, NIGHTS + 1):
        try:
            nights.play(night)
        except AssertionError as error:
            lines = (f"FLEXROAD_NIGHTS_SEED={SEED}", *nights.told, nights.said, str(error))
            pytest.fail("\n".join(lines), pytrace=False)
