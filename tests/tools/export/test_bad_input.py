"""Whatever is wrong, an export writes all of its tiles or ends with one line that says what to do."""

import json
import shutil
from pathlib import Path

import geopandas
import pytest
import shapely

from flexroad.pipeline.run.lock import run_lock
from flexroad.tools.export.driver import BEGUN
from flexroad.tools.export.formats import FORMATS
from tests.permissions import permissions_enforced

from .conftest import contents

DATUM = ("--vertical", "47.5", "--allow-steps")
"""Options of each format; the tiles of the run do not meet."""
WRITTEN_WHOLE = ("mosaic",)
"""Formats that have no markers: each export writes them again."""
each_format = pytest.mark.parametrize("name", FORMATS)


@pytest.fixture
def refused(flexroad):
    """Calls the command, which must end with exit code 2 and one line; returns the line."""

    def call(*words):
        said = flexroad("export", *words)
        assert said.code == 2, said
        (line,) = said.errors
        assert [text for text in said.err.splitlines() if text.startswith("error: ")] == [line]
        return line

    return call


@each_format
def test_tiles_that_failed_or_are_missing_are_left_out(made_city, whole, flexroad, tmp_path, name):
    """The folder has spaces and other letters."""
    out = tmp_path / "für die Stadt (neu)" / "道路"
    said = flexroad("export", made_city.path, "--format", name, *DATUM, "-o", out).expected(0)
    assert "note: left out 2 unfinished tiles" in said.err.splitlines()
    assert contents(out / name) == contents(whole / name)
    manifest = json.loads((out / "export.json").read_text())
    assert manifest["left_out"] == [made_city.failed, made_city.pending]
    assert list(manifest["formats"]) == [name]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--format", "lanxml"], "--format lanxml is unknown; did you mean landxml?; known are "),
        (["--format", "OBJ"], "--format OBJ is unknown; did you mean obj?; known are "),
        (["--format", "usd"], "--format usd is unknown; known are "),
        (["--format", ""], "--format names no format; known are "),
        (["--format", "3dtiles"], "3dtiles needs heights above the ellipsoid of WGS 84"),
        (["--format", "obj", "--bbox", 0, 0, 1, 1], "no tile touches --bbox"),
        (["--format", "obj", "--tile", "4711"], "no tile '4711'"),
        (["--format", "obj", "--tile", "FAILED"], "has no finished tile to export; see `flexroad status"),
        (["--format", "obj", "--area", "absent.gpkg"], "cannot be read"),
        (["--format", "obj", "--area", "AREA"], "no tile touches --area"),
        (["--format", "obj", "--area", "POINTS"], "no polygons"),
    ],
)
def test_formats_and_selections_that_cannot_be_exported_are_refused(
    made_city, refused, tmp_path, words, message
):
    points = tmp_path / "points.geojson"
    points.write_text('{"type": "Point", "coordinates": [9, 50]}')
    named = {"FAILED": made_city.failed, "AREA": area(tmp_path, 0, 0, 10, 10), "POINTS": points}
    out = tmp_path / "out"
    assert message in refused(made_city.path, "-o", out, *(named.get(word, word) for word in words))
    assert not out.exists()


def area(folder, *bounds):
    """Write an area over bounds in longitude and latitude."""
    shape = geopandas.GeoSeries([shapely.box(*bounds)], crs="EPSG:25832")
    shape.to_crs("EPSG:4326").to_file(folder / "area.geojson")
    return folder / "area.geojson"


def test_area_selects_the_tiles_of_an_export_and_of_a_run(town, flexroad, tmp_path):
    west, south, _, _ = town.tiles[0].grid.bounds
    path = area(tmp_path, west + 5, south + 5, west + 20, south + 20)
    said = flexroad(
        "export", town.path, "--format", "mosaic", "--area", path, "-o", tmp_path / "out"
    ).expected(0)
    assert "mosaic: 7 files" in said.out
    assert json.loads((tmp_path / "out" / "export.json").read_text())["tiles"] == 1
    words = "run", "--catalog", town.path / "catalog.parquet", "--out", tmp_path / "run", "--dry-run"
    said = flexroad("--allow", town.path.parent / "survey", *words, "--area", path).expected(0)
    assert [line for line in said.out.splitlines() if line.endswith(": new")] == [f"{town.tiles[0].id}: new"]


def test_folders_that_cannot_be_used_are_refused_and_stay(made_city, refused, tmp_path):
    """No run; a file; a folder in place of the manifest; a folder that cannot be written."""
    (tmp_path / "file").write_text("mine")
    (tmp_path / "taken" / "export.json").mkdir(parents=True)
    (tmp_path / "closed").mkdir(mode=0o555)
    before = sorted(tmp_path.rglob("*"))
    words = "--format", "obj", "-o"
    assert "is no run: run.json is missing or damaged" in refused(tmp_path, *words, tmp_path / "out")
    assert str(tmp_path / "file") in refused(made_city.path, *words, tmp_path / "file")
    assert "export.json" in refused(made_city.path, *words, tmp_path / "taken")
    with permissions_enforced():
        assert "Permission denied" in refused(made_city.path, *words, tmp_path / "closed")
    assert sorted(tmp_path.rglob("*")) == before
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize("part", ["", "tiles", "store/x", "delivery"])
def test_output_in_the_run_is_refused(made_city, refused, part):
    before = sorted(made_city.path.rglob("*"))
    line = refused(made_city.path, "--format", "obj", "-o", made_city.path / part)
    assert f"lies in the run ({made_city.path}" in line
    assert line.endswith("choose a folder outside")
    assert sorted(made_city.path.rglob("*")) == before


@pytest.mark.parametrize("content", ["", "{", "[]", '{"formats": 3}', "\x00"])
def test_damaged_or_read_only_manifest_is_replaced(made_city, flexroad, tmp_path, content):
    (tmp_path / BEGUN).write_text("obj\n")
    (tmp_path / "export.json").write_text(content)
    (tmp_path / "export.json").chmod(0o444)
    with permissions_enforced():
        flexroad("export", made_city.path, "--format", "obj", "-o", tmp_path).expected(0)
    assert json.loads((tmp_path / "export.json").read_text())["tiles"] == 2


@pytest.mark.parametrize("content", ["", "mine", "[]", '{"formats": {}}'])
@pytest.mark.parametrize("file", ["export.json", "mosaic/height.tif"])
def test_files_of_others_are_refused_and_stay(made_city, refused, tmp_path, file, content):
    (tmp_path / "mosaic").mkdir()
    (tmp_path / file).write_text(content)
    line = refused(made_city.path, "--format", "mosaic", "-o", tmp_path)
    assert line.startswith(f"error: {(tmp_path / file).parent}")
    assert "not of an export" in line
    assert Path(file).name in line
    assert [path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path.is_file()] == [Path(file)]
    assert (tmp_path / file).read_text() == content


def test_files_of_others_in_the_folder_of_another_format_are_refused(made_city, refused, flexroad, tmp_path):
    (tmp_path / "mosaic").mkdir()
    (tmp_path / "mosaic" / "height.tif").write_text("mine")
    (tmp_path / "notes.txt").write_text("mine")
    flexroad("export", made_city.path, "--format", "obj", "-o", tmp_path).expected(0)
    line = refused(made_city.path, "--format", "obj,mosaic", "-o", tmp_path)
    assert f"{tmp_path / 'mosaic'} has files that are not of an export, such as height.tif; " in line
    assert (tmp_path / "mosaic" / "height.tif").read_text() == "mine"


def test_folder_that_another_export_writes_is_refused(made_city, refused, flexroad, tmp_path):
    words = [made_city.path, "--format", "obj", "-o", tmp_path]
    with run_lock(tmp_path):
        line = refused(*words)
        assert f"{tmp_path} is in use by pid " in line
        assert not (tmp_path / "obj").exists()
    flexroad("export", *words).expected(0)
    assert not (tmp_path / "lock.json").exists()


@each_format
def test_files_of_tiles_no_longer_selected_are_removed(made_city, flexroad, tmp_path, name):
    # Along the roads of the other tile alone no road has the least length.
    second, first = made_city.done
    words = ["export", made_city.path, "--format", name, *DATUM, "-o"]
    flexroad(*words, tmp_path / "one", "--tile", first).expected(0)
    flexroad(*words, tmp_path / "both").expected(0)
    before = len(contents(tmp_path / "both" / name))
    (tmp_path / "both" / name / "mine.txt").write_text("of the user")
    said = flexroad(*words, tmp_path / "both", "--tile", first).expected(0)
    (tmp_path / "both" / name / "mine.txt").unlink()
    assert contents(tmp_path / "both" / name) == contents(tmp_path / "one" / name)
    left = contents(tmp_path / "one" / name)
    assert not any(second in path for path in left)
    assert ("note: removed " in said.err) == (before > len(left))


def test_formats_of_other_results_are_named_and_leave_the_manifest(made_city, flexroad, tmp_path):
    words = ["export", made_city.path, "-o", tmp_path, "--format"]

    def formats():
        return list(json.loads((tmp_path / "export.json").read_text())["formats"])

    flexroad(*words, "obj,step").expected(0)
    said = flexroad(*words, "landxml").expected(0)
    assert formats() == ["obj", "step", "landxml"]
    assert "earlier" not in said.err
    said = flexroad(*words, "obj", "--tile", made_city.done[0]).expected(0)
    assert formats() == ["obj"]
    for name in ("step", "landxml"):
        assert f"note: {tmp_path / name} is of an earlier export with other results; write" in said.err


@pytest.mark.parametrize("name", ["", "../outside", "/outside", "a/../../outside"])
def test_changed_files_and_files_elsewhere_that_a_marker_names_are_not_removed(
    made_city, flexroad, tmp_path, name
):
    words = ["export", made_city.path, "--format", "obj", "-o", tmp_path / "out"]
    flexroad(*words).expected(0)
    outside, changed = tmp_path / "outside", tmp_path / "out" / "obj" / f"{made_city.done[1]}.obj"
    outside.write_text("kept")
    changed.write_text("# painted by hand")
    if name:
        place = str(outside) if name.startswith("/") else name.replace("outside", "../outside", 1)
        marker = tmp_path / "out" / "obj" / ".pieces" / f"{made_city.done[1]}.json"
        content = json.loads(marker.read_text())
        marker.write_text(json.dumps(content | {"sizes": {place: 4, "../../outside": 4}}))
    flexroad(*words, "--tile", made_city.done[0]).expected(0)
    assert outside.read_text() == "kept"
    assert changed.read_text() == "# painted by hand"
    # A marker that names files elsewhere is as none.
    assert changed.with_suffix(".json").exists() == bool(name)


@each_format
def test_damaged_markers_are_as_none(made_city, whole, flexroad, tmp_path, name):
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    hidden = [*tmp_path.glob(f"{name}/.pieces/**/*.json"), *tmp_path.glob(f".{name}.json")]
    assert hidden or name in WRITTEN_WHOLE
    for number, file in enumerate(hidden):
        file.write_text(["", "{", "[1]", '{"key": 1, "sizes": 3, "row": 2}'][number % 4])
    flexroad("export", made_city.path, "--format", name, *DATUM, "-o", tmp_path).expected(0)
    assert contents(tmp_path / name) == contents(whole / name)
