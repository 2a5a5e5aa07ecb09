"""The manifest of an export has what docs/export.md says, and its errors are those of the files."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.store.tables import read_metrics
from flexroad.tasks.metrics.evaluate import FIGURES
from flexroad.tools.export.driver import export
from flexroad.tools.export.formats import FORMATS
from flexroad.tools.export.source import select

from .conftest import OPTIONS

DOCS = Path(__file__).parents[3] / "docs" / "export.md"
MEASURED = {"landxml", "cityjson", "obj"}
OF_MESHES = {"3dtiles", "landxml", "cityjson", "obj"}


@pytest.fixture(scope="module")
def exported(made_city, tmp_path_factory):
    out = tmp_path_factory.mktemp("manifest")
    export(select(made_city.path), out, list(FORMATS), OPTIONS, SerialExecutor())
    return out


@pytest.fixture(scope="module")
def manifest(exported):
    return json.loads((exported / "export.json").read_text())


def documented() -> set[str]:
    section = DOCS.read_text().split("## The manifest")[1].split("\n## ")[0]
    rows = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
    entries = {name for row in rows for name in re.findall(r"`([^`]+)`", row)}
    described = re.search(r"`formats\.NAME` \|([^|]*)\|", section)
    return entries | {f"formats.NAME.{name}" for name in re.findall(r"`([^`]+)`", described[1])}


def test_entries_are_those_of_the_documentation(manifest):
    said = set(manifest) - {"formats"}
    said |= {f"formats.NAME.{name}" for entry in manifest["formats"].values() for name in entry}
    assert said == documented() - {"formats.NAME"}


def test_formats_are_as_declared(manifest):
    assert list(manifest["formats"]) == list(FORMATS)
    for name, entry in manifest["formats"].items():
        kind = FORMATS[name]
        assert (entry["title"], entry["version"], entry["precision_m"]) == (
            kind.title,
            kind.version,
            kind.precision_m,
        )
        assert ("height_error_m" in entry) == (name in MEASURED)
        assert ("datum" in entry) == kind.needs_datum
        assert ("mesh_distances" in entry) == kind.of_meshes == (name in OF_MESHES)


def test_mesh_distances_are_the_largest_of_the_tiles(made_city, manifest):
    rows = read_metrics(made_city.path)
    expected = {name: rows[name].max() for name in FIGURES}
    assert manifest["formats"]["obj"]["mesh_distances"] == pytest.approx(expected)
    assert 0 < expected["mesh_p95_road_m"] < expected["mesh_max_road_m"]
    summary = json.loads((made_city.path / "summary.json").read_text())
    assert summary["mesh_distances"]["flexroad"] == pytest.approx(expected)


def test_height_error_of_obj_is_that_of_its_vertices(made_city, exported, manifest):
    errors = []
    for tile in select(made_city.path).finished():
        lines = (exported / "obj" / f"{tile.id}.obj").read_text().splitlines()
        origin = json.loads((exported / "obj" / f"{tile.id}.json").read_text())["origin"]
        east, north, height = (
            np.array([line.split()[1:] for line in lines if line.startswith("v ")], float) + origin
        ).T
        errors.append(np.abs(tile.surface.height(east, north) - height).max())
    assert manifest["formats"]["obj"]["height_error_m"] == pytest.approx(max(errors), abs=1e-7)
    assert 0 < max(errors) < 0.001


def test_height_error_of_cityjson_is_that_of_its_vertices(made_city, exported, manifest):
    head, *features = map(json.loads, (exported / "cityjson" / "city.city.jsonl").read_text().splitlines())
    scale, shift = (np.array(head["transform"][name]) for name in ("scale", "translate"))
    surfaces = {tile.id: tile.surface for tile in select(made_city.path).finished()}
    errors = []
    for feature in features:
        (item,) = feature["CityObjects"].values()
        east, north, height = (np.array(feature["vertices"]) * scale + shift).T
        errors.append(np.abs(surfaces[item["attributes"]["tile"]].height(east, north) - height).max())
    assert manifest["formats"]["cityjson"]["height_error_m"] == pytest.approx(max(errors), abs=1e-7)


def test_results_name_the_meshes(made_city, exported, manifest, tmp_path):
    both = export(select(made_city.path), tmp_path, ["step"], OPTIONS, SerialExecutor())
    one = export(select(made_city.path, made_city.done[:1]), tmp_path, ["step"], OPTIONS, SerialExecutor())
    assert both["results"] == manifest["results"] != one["results"]
