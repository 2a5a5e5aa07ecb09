"""The wheel, the container file, the conda recipes and the built viewer belong to the sources."""

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
from flexroad.pipeline.execute.workers import checksum_of_code

ROOT = Path(__file__).parent.parent
TABLES = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT = TABLES["project"]
PINS = dict(line.split("==") for line in (ROOT / "constraints.txt").read_text().split())
CONTAINER = (ROOT / "Containerfile").read_text()
VIEWER = ROOT / "viewer"
OPERATIONS = ROOT / "docs" / "operations"
RECIPES = {
    path.parent.name: yaml.safe_load(path.read_text()) for path in OPERATIONS.glob("conda/*/recipe.yaml")
}
CONDA = {
    "dask[distributed]": ("dask-core", "distributed"),
    "isal": ("python-isal",),
    "laspy[lazrs]": ("laspy", "lazrs-python"),
    "matplotlib": ("matplotlib-base",),
    "opencv-python-headless": ("py-opencv",),
    "torch": ("pytorch",),
    "universal-pathlib": ("universal_pathlib",),
}
"""Names on PyPI -> names on conda-forge where they differ by more than capitals."""


def of_conda(requirements: list[str]) -> list[str]:
    """Return requirements of pyproject.toml as conda's, such as ``pydantic >=2``, sorted."""
    parts = [re.fullmatch(r"([\w.-]+(?:\[\w+\])?)(.*)", requirement).groups() for requirement in requirements]
    return sorted(
        f"{to} {version}".strip() for name, version in parts for to in CONDA.get(name, (name.lower(),))
    )


def test_recipe_is_that_of_the_project():
    recipe, python = RECIPES["flexroad"], f"python {PROJECT['requires-python']}"
    assert recipe["requirements"]["run"][0] == python
    assert sorted(recipe["requirements"]["run"][1:]) == of_conda(PROJECT["dependencies"])
    backend = of_conda(TABLES["build-system"]["requires"])
    assert sorted(recipe["requirements"]["host"]) == sorted([python, "pip", *backend])
    assert recipe["package"] == {"name": PROJECT["name"], "version": "${{ version }}"}
    assert recipe["context"]["version"] == PROJECT["version"]
    commands = [f"{name} = {target}" for name, target in PROJECT["scripts"].items()]
    assert recipe["build"]["python"]["entry_points"] == commands
    about = recipe["about"]["license"], recipe["about"]["summary"]
    assert about == (PROJECT["license"], PROJECT["description"])
    assert (OPERATIONS / "conda" / "flexroad" / recipe["source"]["path"]).resolve() == ROOT
    assert RECIPES["startinpy"]["context"]["version"] == PINS["startinpy"]


def test_container_has_the_versions_threads_extras_and_user_of_the_project():
    assert re.findall(r"torch==(\S+)", CONTAINER) == [PINS["torch"]]
    assert "--constraint /src/constraints.txt" in CONTAINER
    for name, value in ONE_THREAD.items():
        assert re.search(rf"^    {name}={value}\b", CONTAINER, re.MULTILINE)
    (extras,) = re.findall(r"ARG EXTRAS=(\S+)", CONTAINER)
    assert set(extras.split(",")) <= PROJECT["optional-dependencies"].keys()
    cronjob = yaml.safe_load((OPERATIONS / "cronjob.yaml").read_text())
    pod = cronjob["spec"]["jobTemplate"]["spec"]["template"]["spec"]
    assert re.findall(r"^USER (\d+)$", CONTAINER, re.MULTILINE) == [str(pod["securityContext"]["runAsUser"])]


@pytest.mark.slow
def test_wheel_built_from_the_files_of_the_container_is_complete(tmp_path):
    context, built = tmp_path / "context", tmp_path / "built"
    context.mkdir()
    patterns = [line for line in (ROOT / ".containerignore").read_text().splitlines() if line[:1] not in "#"]
    assert patterns[0] == "*"
    ignored = shutil.ignore_patterns("__pycache__")
    for name in (pattern.removeprefix("!") for pattern in patterns if pattern.startswith("!")):
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, context / name, symlinks=True, ignore=ignored)
        else:
            shutil.copy(ROOT / name, context / name)
    build = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "-w", built]
    subprocess.run([*build, context], check=True, capture_output=True)
    (wheel,) = built.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        archive.extractall(tmp_path)
    top = {name.split("/")[0] for name in names}
    assert top == {"flexroad", f"{wheel.name.removesuffix('-py3-none-any.whl')}.dist-info"}
    files = [
        path for part in ("catalog", "tasks", "pipeline", "tools") for path in (ROOT / part).rglob("*.py")
    ]
    files += (ROOT / "configs").glob("*.yaml")
    files += filter(Path.is_file, (ROOT / "viewer" / "dist").rglob("*"))
    assert {"flexroad/py.typed", *(f"flexroad/{path.relative_to(ROOT)}" for path in files)} <= set(names)
    # Clients and workers may be installed in either way.
    assert checksum_of_code(tmp_path / "flexroad") == checksum_of_code()


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


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("npm") is None, reason="npm is not installed")
def test_viewer_built_again_has_the_same_bytes(tmp_path):
    copy = shutil.copytree(VIEWER, tmp_path / "viewer", ignore=shutil.ignore_patterns("node_modules", "dist"))
    install = ["npm", "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--prefer-offline"]
    subprocess.run(install, cwd=copy, check=True, capture_output=True)
    subprocess.run(["node", "build.js", tmp_path / "built"], cwd=copy, check=True, capture_output=True)
    again, built = (
        {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}
        for folder in (tmp_path / "built", VIEWER / "dist")
    )
    assert again == built


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed")
def test_parts_of_the_viewer_pass_their_own_tests():
    done = subprocess.run(
        ["node", "--test", "tests/"], cwd=VIEWER, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout


def test_lock_file_names_no_server():
    assert '"resolved"' not in (VIEWER / "package-lock.json").read_text()
