"""An export has the surface of the run, goes on after interruptions, and its manifest is as in the docs."""

import gzip
import json
import re
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.progress import step_progress
from flexroad.pipeline.store.tables import read_metrics
from flexroad.tasks.errors import TaskError
from flexroad.tasks.metrics.evaluate import FIGURES
from flexroad.tools.export import tile_outputs
from flexroad.tools.export.driver import export
from flexroad.tools.export.formats import FORMATS
from flexroad.tools.export.georeference import Datum
from flexroad.tools.export.source import Options, select
from tests.read_exports import off_surface, vertices

from .conftest import OPTIONS, contents

DOCS = Path(__file__).parents[3] / "docs" / "export.md"
MEASURED = {"landxml", "cityjson", "obj"}
OF_MESHES = {"3dtiles", *MEASURED}


@pytest.fixture(scope="module")
def exported(town, tmp_path_factory):
    out, formats = tmp_path_factory.mktemp("out"), ["3dtiles", "landxml", "cityjson", "obj"]
    export(select(town.path), out, formats, OPTIONS, SerialExecutor())
    return out


def test_vertices_of_all_formats_lie_on_the_surface(town, exported):
    for name, points in vertices(exported).items():
        assert len(points) > 500
        error = off_surface(town.path, points[::3])
        # On a slope, the error in plan is also one in height; vertices on borders may be just outside.
        assert np.nanmax(error) <= 2 * FORMATS[name].precision_m, name
        assert np.isfinite(error).mean() > 0.95


def test_export_again_writes_only_what_is_missing_or_of_other_options(town, tmp_path, monkeypatch):
    written = []
    write = tile_outputs._write

    def counted(job):
        written.append(job.tile.id)
        return write(job)

    monkeypatch.setattr(tile_outputs, "_write", counted)

    def again(options=OPTIONS):
        written.clear()
        export(select(town.path), tmp_path, ["3dtiles"], options, SerialExecutor())
        return len(written)

    # Three tiles, and a coarse mesh of all.
    assert again() == 4
    before = (tmp_path / "3dtiles" / "tileset.json").read_bytes()
    assert again() == 0
    next((tmp_path / "3dtiles" / "tiles").iterdir()).unlink()
    assert again() == 1
    next((tmp_path / "3dtiles" / ".pieces").rglob("*.json")).write_text("{")
    assert again() == 1
    assert (tmp_path / "3dtiles" / "tileset.json").read_bytes() == before
    assert again(replace(OPTIONS, datum=Datum("offset", "1"))) == 4


def test_compressed_landxml_has_the_same_content(town, exported, tmp_path):
    export(select(town.path), tmp_path, ["landxml"], Options(compress=True), SerialExecutor())
    (file,) = (tmp_path / "landxml").iterdir()
    assert file.name.endswith(".xml.gz")
    (plain,) = (exported / "landxml").iterdir()
    assert gzip.decompress(file.read_bytes()) == plain.read_bytes()


def test_selection_by_id_and_box(town):
    first, second, _, fourth = town.tiles
    assert select(town.path, ids=[second.id]).tiles == (second,)
    assert select(town.path, bbox=first.grid.bounds).tiles == (first,)
    with pytest.raises(ConfigError, match="has no finished tile to export; see `flexroad status"):
        select(town.path, ids=[fourth.id])


def test_error_ends_the_progress_lines(town, tmp_path, monkeypatch):
    def fail(source, tiles, folder, options, executor):
        next(iter(tiles))
        raise TaskError("no space")

    monkeypatch.setitem(FORMATS, "obj", replace(FORMATS["obj"], write=fail))
    before = threading.active_count()
    track = step_progress(Console(quiet=True))
    with pytest.raises(ConfigError, match="obj: no space") as raised:
        export(select(town.path), tmp_path, ["obj"], OPTIONS, SerialExecutor(), track)
    assert raised.tb  # It refers to the iterator of the tiles.
    assert threading.active_count() == before


@pytest.fixture(scope="module")
def manifest(whole):
    return json.loads((whole / "export.json").read_text())


def documented() -> set[str]:
    section = DOCS.read_text().split("## The manifest")[1].split("\n## ")[0]
    rows = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
    entries = {name for row in rows for name in re.findall(r"`([^`]+)`", row)} - {"formats.NAME"}
    described = re.search(r"`formats\.NAME` \|([^|]*)\|", section)
    return entries | {f"formats.NAME.{name}" for name in re.findall(r"`([^`]+)`", described[1])}


def test_manifest_has_the_documented_entries_and_says_what_was_written(made_city, whole, manifest):
    said = set(manifest) - {"formats"}
    said |= {f"formats.NAME.{name}" for entry in manifest["formats"].values() for name in entry}
    assert said == documented()
    assert (manifest["tiles"], manifest["left_out"]) == (2, [made_city.failed, made_city.pending])
    assert manifest["crs"] == "EPSG:25832"
    assert manifest["datum"] == "heights plus 47.5 m are above the ellipsoid"
    assert list(manifest["formats"]) == list(FORMATS)
    for name, entry in manifest["formats"].items():
        kind, files = FORMATS[name], contents(whole / name).values()
        assert (entry["title"], entry["version"], entry["precision_m"]) == (
            kind.title,
            kind.version,
            kind.precision_m,
        )
        assert (entry["files"], entry["bytes"]) == (len(files), sum(map(len, files)))
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


def test_height_errors_are_those_of_the_vertices_and_results_name_the_meshes(made_city, manifest, tmp_path):
    one = select(made_city.path, made_city.done[:1])
    (tile,) = one.finished()
    said = export(one, tmp_path, list(OF_MESHES), OPTIONS, SerialExecutor())
    assert said["results"] != manifest["results"]
    for name, points in vertices(tmp_path).items():
        if name not in MEASURED:
            continue
        east, north, height = points.T
        error = np.abs(tile.surface.height(east, north) - height).max()
        assert said["formats"][name]["height_error_m"] == pytest.approx(error, abs=1e-7)
        assert 0 < error < 0.001
        assert error <= manifest["formats"][name]["height_error_m"]
