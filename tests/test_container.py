"""The container file has the versions, threads and user of the project, and all files that it needs."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml

from flexroad.pipeline import ONE_THREAD

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PINS = dict(line.split("==") for line in (ROOT / "constraints.txt").read_text().split())
CONTAINER = (ROOT / "Containerfile").read_text()


def test_container_has_the_pinned_torch_and_one_thread_per_process():
    assert re.findall(r"torch==(\S+)", CONTAINER) == [PINS["torch"]]
    assert "--constraint /src/constraints.txt" in CONTAINER
    for name, value in ONE_THREAD.items():
        assert re.search(rf"^    {name}={value}\b", CONTAINER, re.MULTILINE)


def test_container_extras_and_user_are_those_of_the_project():
    (extras,) = re.findall(r"ARG EXTRAS=(\S+)", CONTAINER)
    assert set(extras.split(",")) <= PROJECT["project"]["optional-dependencies"].keys()
    cronjob = yaml.safe_load((ROOT / "docs/operations/cronjob.yaml").read_text())
    pod = cronjob["spec"]["jobTemplate"]["spec"]["template"]["spec"]
    assert re.findall(r"^USER (\d+)$", CONTAINER, re.MULTILINE) == [str(pod["securityContext"]["runAsUser"])]


@pytest.mark.slow
def test_container_context_is_enough_to_build_the_wheel(tmp_path):
    context, built = tmp_path / "context", tmp_path / "built"
    context.mkdir()
    patterns = [line for line in (ROOT / ".containerignore").read_text().splitlines() if line[:1] not in "#"]
    assert patterns[0] == "*"
    kept = [pattern.removeprefix("!") for pattern in patterns if pattern.startswith("!")]
    ignored = shutil.ignore_patterns("__pycache__")
    for name in kept:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, context / name, symlinks=True, ignore=ignored)
        else:
            shutil.copy(ROOT / name, context / name)
    build = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "-w", built]
    subprocess.run([*build, context], check=True, capture_output=True)
    (wheel,) = built.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    parts = ("catalog", "tasks", "pipeline", "tools")
    files = [path for part in parts for path in (ROOT / part).rglob("*.py")]
    files += (ROOT / "configs").glob("*.yaml")
    files += filter(Path.is_file, (ROOT / "viewer" / "dist").rglob("*"))
    assert {f"flexroad/{path.relative_to(ROOT)}" for path in files} <= set(names)


@pytest.mark.slow
def test_container_compiles_what_a_run_of_another_user_needs(tmp_path):
    """The step of the container file, with other folders; the user's home folder and survey are others."""
    compiled, tile, home = tmp_path / "compiled", tmp_path / "tile", tmp_path / "home"
    (folder,) = re.findall(r"NUMBA_CACHE_DIR=(\S+)", CONTAINER)
    (step,) = re.findall(r"^RUN (export HOME=.*?)^USER", CONTAINER, re.MULTILINE | re.DOTALL)
    environment = os.environ | {"NUMBA_CACHE_DIR": str(compiled)}
    environment["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), environment["PATH"]])

    def shell(commands, **variables):
        subprocess.run(["sh", "-ec", commands], check=True, capture_output=True, env=environment | variables)

    shell(step.replace("/tmp/tile", str(tile)).replace(folder, str(compiled)))
    kernels = {path: path.stat().st_mtime_ns for path in compiled.rglob("*") if path.is_file()}
    assert kernels
    assert not tile.exists()
    assert all(path.stat().st_mode & 0o006 == 0o006 for path in kernels)
    survey = "flexroad catalog synthetic --tiles 2 --tile-size 100 --seed 7 -o survey"
    run = "flexroad run --catalog survey/catalog.parquet --out run"
    home.mkdir()
    shell(f"cd {home}; {survey}; {run}", HOME=str(home))
    assert {path: path.stat().st_mtime_ns for path in compiled.rglob("*") if path.is_file()} == kernels
