"""The conda recipes agree with pyproject.toml and constraints.txt."""

import re
import tomllib
from pathlib import Path

import yaml

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PINS = dict(line.split("==") for line in (ROOT / "constraints.txt").read_text().split())
FOLDER = ROOT / "docs" / "operations" / "conda"
RECIPES = {path.parent.name: yaml.safe_load(path.read_text()) for path in FOLDER.glob("*/recipe.yaml")}
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


def of_conda(requirement: str) -> list[str]:
    """Return a requirement of pyproject.toml as conda's requirements, such as ``pydantic >=2``."""
    name, version = re.fullmatch(r"([\w.-]+(?:\[\w+\])?)(.*)", requirement).groups()
    return [f"{package} {version}".strip() for package in CONDA.get(name, (name.lower(),))]


def test_recipe_requires_what_the_project_requires():
    project = PROJECT["project"]
    python = f"python {project['requires-python']}"
    needed = [package for requirement in project["dependencies"] for package in of_conda(requirement)]
    requirements = RECIPES["flexroad"]["requirements"]
    assert requirements["run"][0] == python
    assert sorted(requirements["run"][1:]) == sorted(needed)
    backend = [
        package for requirement in PROJECT["build-system"]["requires"] for package in of_conda(requirement)
    ]
    assert sorted(requirements["host"]) == sorted([python, "pip", *backend])


def test_recipe_has_name_version_licence_and_command_of_the_project():
    project, recipe = PROJECT["project"], RECIPES["flexroad"]
    assert recipe["package"] == {"name": project["name"], "version": "${{ version }}"}
    assert recipe["context"]["version"] == project["version"]
    commands = [f"{name} = {target}" for name, target in project["scripts"].items()]
    assert recipe["build"]["python"]["entry_points"] == commands
    assert (recipe["about"]["license"], recipe["about"]["summary"]) == (
        project["license"],
        project["description"],
    )
    assert (FOLDER / "flexroad" / recipe["source"]["path"]).resolve() == ROOT


def test_recipe_of_startinpy_has_the_tested_version():
    assert RECIPES["startinpy"]["context"]["version"] == PINS["startinpy"]
