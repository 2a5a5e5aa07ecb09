"""Units in docs/operations: valid for systemd, Kubernetes and SLURM, with valid flexroad commands."""

import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
import typer
import yaml

from flexroad.pipeline.cli.main import app

SCRIPT = "flexroad-nightly.sh"
INSTALLED = "/usr/local/bin/flexroad-nightly"
"""Where the script is copied to."""
FAILED = "flexroad-failed@flexroad.service.service"
"""The unit that flexroad.service starts when it fails."""
UNITS = Path(__file__).parent.parent / "docs" / "operations"
JOB = yaml.safe_load((UNITS / "cronjob.yaml").read_text())
POD = JOB["spec"]["jobTemplate"]["spec"]["template"]["spec"]


def text(name: str) -> str:
    return (UNITS / name).read_text()


def command(name: str) -> list[str]:
    """The words of the flexroad command in a unit, after parsing by the shell."""
    if name == "cronjob.yaml":
        return POD["containers"][0]["command"][1:]
    (line,) = re.findall(r"^[^#\n]*/bin/flexroad (run .*)$", text(name), flags=re.MULTILINE)
    return shlex.split(line.replace("$SLURM_CPUS_PER_TASK", "32").removesuffix(' "$@"'))


@pytest.mark.parametrize("name", [SCRIPT, "cronjob.yaml", "flexroad.sbatch"])
def test_unit_command_runs(name, made_survey, tmp_path, capsys):
    words = command(name)
    words[words.index("--catalog") + 1] = str(made_survey / "catalog.parquet")
    words[words.index("--out") + 1] = str(tmp_path / "run")
    typer.main.get_command(app)([*words, "--dry-run"], standalone_mode=False)
    assert "to do" in capsys.readouterr().out


@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="systemd is not installed")
def test_systemd_accepts_service_and_timer(tmp_path):
    program = shutil.which("true")
    (tmp_path / "flexroad.service").write_text(text("flexroad.service").replace(INSTALLED, program))
    for name in ("flexroad.timer", "flexroad-failed@.service"):
        (tmp_path / name).write_text(text(name))
    units = [tmp_path / "flexroad.service", tmp_path / "flexroad.timer", tmp_path / FAILED]
    done = subprocess.run(["systemd-analyze", "verify", *units], capture_output=True, text=True, check=False)
    # The output may also have complaints about units of the machine.
    complaints = [line for line in done.stderr.splitlines() if "flexroad" in line]
    assert not complaints
    assert done.returncode == 0, done.stderr
    calendar = re.search(r"OnCalendar=(.*)", text("flexroad.timer"))[1]
    subprocess.run(["systemd-analyze", "calendar", calendar], capture_output=True, check=True)


def test_failed_unit_mails_the_end_of_the_log(tmp_path):
    (line,) = re.findall(r"^ExecStart=(.*)$", text("flexroad-failed@.service"), flags=re.MULTILINE)
    mail = tmp_path / "mail"
    mail.write_text(f'#!/bin/sh\nprintf "%s\\n" "$@" > {tmp_path}/words\ncat > {tmp_path}/body\n')
    mail.chmod(0o755)
    log = tmp_path / "runs" / "city.log"
    log.parent.mkdir()
    log.write_text("".join(f"line {number}\n" for number in range(30)))
    for place, value in (("%i", "flexroad.service"), ("%H", "host"), ("/srv/flexroad", str(tmp_path))):
        line = line.replace(place, value)
    environment = {"PATH": f"{tmp_path}:{os.environ['PATH']}"}
    subprocess.run(shlex.split(line), env=environment, check=True)
    assert (tmp_path / "words").read_text() == "-s\nflexroad.service failed on host\noperator\n"
    body = (tmp_path / "body").read_text().splitlines()
    assert body == [f"line {number}" for number in range(10, 30)]


def test_sbatch_script_is_valid():
    subprocess.run(["bash", "-n", UNITS / "flexroad.sbatch"], check=True)
    options = dict(re.findall(r"^#SBATCH --([a-z-]+)=(\S+)$", text("flexroad.sbatch"), flags=re.MULTILINE))
    assert len(options) == text("flexroad.sbatch").count("\n#SBATCH ")
    # B: sends the signal to the batch shell, which exec replaces by flexroad.
    assert re.fullmatch(r"B:TERM@\d+", options["signal"])
    assert "\nexec " in text("flexroad.sbatch")
    assert options["nodes"] == options["ntasks"] == "1"
    # Directives after the first command are comments.
    assert text("flexroad.sbatch").rindex("#SBATCH ") < text("flexroad.sbatch").index("set -euo")


def test_cronjob_has_what_kubernetes_requires_and_one_cpu_per_worker():
    # Kubernetes accepts a podFailurePolicy only with restartPolicy Never.
    assert POD["restartPolicy"] == "Never"
    assert len(JOB["spec"]["schedule"].split()) == 5
    (container,) = POD["containers"]
    limits, words = container["resources"]["limits"], container["command"]
    assert limits == container["resources"]["requests"]
    assert words[words.index("--workers") + 1] == limits["cpu"]
    mounted = {mount["name"] for mount in container["volumeMounts"]}
    assert mounted == {volume["name"] for volume in POD["volumes"]}
