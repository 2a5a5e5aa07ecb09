"""The viewer's folder is complete or has no page, and has what the run has."""

import base64
import http.client
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import zlib

import numpy as np
import pytest
import rasterio
from pyproj import Transformer

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.tasks.quality.assess import LIMITS
from flexroad.tools.export.source import select
from flexroad.tools.synthetic.scenes import write_scenes
from flexroad.tools.view import driver as viewer
from flexroad.tools.view.driver import PAGE, server, write_viewer


@pytest.fixture(scope="module")
def city(tmp_path_factory):
    """A run of four tiles of 60 m with orthophotos: two done and flagged, one failed, one not computed."""
    folder = tmp_path_factory.mktemp("view")
    catalog = Catalog.read(write_scenes(folder / "survey", 4, seed=3, size_m=60, dop=True))
    broken = catalog.tiles[2].layer("dsm")
    catalog.tiles[2].paths(broken)[0].write_bytes(b"<script>")
    run = Run.create(folder / "city", load_config("production"), catalog)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(LIMITS, "error-estimate", 1e-6)
        run_tiles(run, SerialExecutor(), only=lambda tile: tile != catalog.tiles[3])
    return run.path


@pytest.fixture(scope="module")
def folder(city, tmp_path_factory):
    out = tmp_path_factory.mktemp("page")
    write_viewer(Run.open(city), out, SerialExecutor())
    return out


def handed_over(path):
    """The arguments of the call in a script."""
    text = path.read_text("ascii")
    start, end = text.index("("), text.rindex(")")
    return json.loads(f"[{text[start + 1 : end]}]")


def test_index_has_all_tiles_with_their_states_and_errors(city, folder):
    (index,) = handed_over(folder / "run.js")
    assert "levels" not in index
    tiles = index["tiles"]
    assert sorted(tiles["state"]) == [viewer.PENDING, viewer.DONE, viewer.DONE, viewer.FAILED]
    failed = tiles["state"].index(viewer.FAILED)
    assert tiles["error"][failed].startswith("load: ")
    assert [bool(error) for error in tiles["error"]].count(True) == 1
    grids = {tile.id: tile.grid for tile in Run.open(city).catalog.tiles}
    for tile_id, west, north in zip(tiles["id"], tiles["west"], tiles["height"], strict=True):
        assert (west, north) == (grids[tile_id].west, 60)
    done = [state == viewer.DONE for state in tiles["state"]]
    assert [value is not None for value in tiles["measures"]["error_estimate_m"]] == done


def test_index_has_the_places_of_the_flags_of_finished_tiles(city, folder):
    (index,) = handed_over(folder / "run.js")
    finished = {tile.id: tile for tile in select(city).finished()}
    assert len(finished) == 2
    for tile_id, flags, found in zip(
        *(index["tiles"][name] for name in ("id", "flags", "places")), strict=True
    ):
        assert set(found) == set(flags)
        assert set(flags) == ({"error-estimate"} if tile_id in finished else set())
        for easting, northing in found.values():
            core, mask = finished[tile_id].data.core, finished[tile_id].road.mask
            inside = finished[tile_id].data.grid.window(core)
            row, col = round(core.north - northing - 0.5), round(easting - core.west - 0.5)
            assert (core.eastings[col], core.northings[row]) == (easting, northing)
            near = mask[inside][max(0, row - 6) : row + 7, max(0, col - 6) : col + 7]
            assert near.any()


def test_tile_script_has_surface_rasters_and_degrees_of_the_run(city, folder):
    tile = Run.open(city).catalog.tiles[0]
    tile_id, scene = handed_over(folder / "tiles" / f"{tile.id}.js")
    assert tile_id == tile.id
    grid = scene["grid"]
    assert (grid["west"], grid["rows"], grid["cols"]) == (tile.grid.west, 60, 60)
    codes = np.frombuffer(zlib.decompress(base64.b64decode(scene["dtm"]["data"])), "<u2").reshape(60, 60)
    assert (codes > 0).all()
    assert zlib.decompress(base64.b64decode(scene["glb"]))[:4] == b"glTF"
    to_degrees = Transformer.from_crs(tile.grid.crs, "EPSG:4326", always_xy=True)
    west, south, east, north = tile.grid.bounds
    assert scene["corners"][0] == pytest.approx(to_degrees.transform(west, south), abs=1e-8)
    assert scene["corners"][3] == pytest.approx(to_degrees.transform(east, north), abs=1e-8)
    assert scene["lines"]
    assert all(-0.01 <= value <= 60.01 for line in scene["lines"] for value in line["points"])


def test_pictures_are_of_the_finished_tiles(folder):
    (index,), (pictures,) = (handed_over(folder / name) for name in ("run.js", "pictures.js"))
    states = dict(zip(index["tiles"]["id"], index["tiles"]["state"], strict=True))
    assert index["pictures"]
    assert sorted(pictures) == sorted(tile for tile, state in states.items() if state == viewer.DONE)
    assert all(base64.b64decode(text)[8:12] == b"WEBP" for text in pictures.values())


def test_interrupted_writing_leaves_no_page(city, tmp_path, monkeypatch):
    """A folder with hidden files alone is taken."""
    (tmp_path / ".DS_Store").write_bytes(b"x")
    write_viewer(Run.open(city), tmp_path, SerialExecutor())
    assert (tmp_path / PAGE).exists()

    def fails(*_, **__):
        raise OSError("disk full")

    monkeypatch.setattr(viewer, "write_outputs", fails)
    with pytest.raises(OSError, match="disk full"):
        write_viewer(Run.open(city), tmp_path, SerialExecutor())
    assert not (tmp_path / PAGE).exists()


@pytest.mark.parametrize("name", [PAGE, "notes.txt"])
def test_folder_with_files_of_others_is_refused(city, tmp_path, name):
    (tmp_path / name).write_text("<h1>mine</h1>")
    message = f"has files that are not of a viewer, such as {name}; choose an empty or new folder"
    with pytest.raises(ConfigError, match=message):
        write_viewer(Run.open(city), tmp_path, SerialExecutor())
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [(name, "<h1>mine</h1>")]


@pytest.mark.parametrize("inside", [".", "..", "tiles", "tiles/viewer", "store", "run.json"])
def test_folder_of_the_run_and_file_are_refused(city, inside):
    before = sorted(city.rglob("*"))
    message = "is a file; choose a folder with -o" if inside == "run.json" else "choose another"
    with pytest.raises(ConfigError, match=message):
        write_viewer(Run.open(city), city / inside, SerialExecutor())
    assert sorted(city.rglob("*")) == before


def test_viewer_of_another_run_is_kept(city, tmp_path):
    run = Run.open(city)
    tile = [run.catalog.tiles[0].id]
    write_viewer(run, tmp_path / "page", SerialExecutor(), tile)
    before = (tmp_path / "page" / PAGE).stat().st_mtime_ns
    moved = shutil.copytree(city, tmp_path / "moved", symlinks=True)
    with pytest.raises(ConfigError, match=f"has the viewer of {city}; choose another folder"):
        write_viewer(Run.open(moved), tmp_path / "page", SerialExecutor(), tile)
    assert (tmp_path / "page" / PAGE).stat().st_mtime_ns == before


def test_viewer_that_was_brought_up_to_date_equals_a_new_one(city, tmp_path):
    run = Run.open(city)
    one, another = ([tile.id] for tile in run.catalog.tiles[:2])

    def files(name):
        return {file.name: file.read_bytes() for file in (tmp_path / name).rglob("*") if file.is_file()}

    write_viewer(run, tmp_path / "old", SerialExecutor(), one)
    for name in ("old", "new"):
        write_viewer(run, tmp_path / name, SerialExecutor())
    assert files("old") == files("new")
    before = {file: file.stat().st_mtime_ns for file in (tmp_path / "old" / "tiles").iterdir()}
    written = write_viewer(run, tmp_path / "old", SerialExecutor())
    assert (written.tiles, written.others, written.notes) == (2, 2, ())
    assert {file: file.stat().st_mtime_ns for file in (tmp_path / "old" / "tiles").iterdir()} == before
    for name in ("old", "small"):
        write_viewer(run, tmp_path / name, SerialExecutor(), another)
    assert files("old") == files("small")


def test_used_port_is_named(city, flexroad, tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        said = flexroad("view", city, "-o", tmp_path / "page", "--serve", "--port", port).expected(2)
    assert said.errors[-1] == f"error: port {port} is in use; choose another with --port, or leave it out"


def test_selection_without_a_surface_is_a_map_alone(city, tmp_path):
    run = Run.open(city)
    written = write_viewer(run, tmp_path, SerialExecutor(), [run.catalog.tiles[2].id])
    assert (written.tiles, written.others) == (0, 1)
    assert (tmp_path / PAGE).exists()
    assert not (tmp_path / "tiles").exists()


def test_missing_sources_are_noted_and_the_mesh_is_shown(city, tmp_path):
    run = Run.open(city)
    tile = run.catalog.tiles[0]
    file = tile.paths(tile.layer("dop"))[0]
    aside = file.with_suffix(".aside")
    file.rename(aside)
    try:
        written = write_viewer(run, tmp_path, SerialExecutor(), [tile.id])
    finally:
        aside.rename(file)
    assert len(written.notes) == 1
    assert written.notes[0].startswith(f"tile {tile.id}: no photo: ")
    assert handed_over(tmp_path / "tiles" / f"{tile.id}.js")[1]["glb"]
    assert write_viewer(run, tmp_path, SerialExecutor(), [tile.id]).notes == ()


def test_changed_photo_changes_the_script_of_its_tile_alone(city, tmp_path):
    run = Run.open(city)
    tile, other = run.catalog.tiles[:2]
    write_viewer(run, tmp_path, SerialExecutor())
    scripts = [tmp_path / "tiles" / f"{each.id}.js" for each in (tile, other)]
    before = [script.read_bytes() for script in scripts]
    file = tile.paths(tile.layer("dop"))[0]
    kept = file.read_bytes(), file.stat().st_mtime_ns
    try:
        with rasterio.open(file, "r+") as photo:
            photo.write(255 - photo.read())
        write_viewer(Run.open(city), tmp_path, SerialExecutor())
    finally:
        file.write_bytes(kept[0])
        os.utime(file, ns=(kept[1], kept[1]))
    changed = [script.read_bytes() != old for script, old in zip(scripts, before, strict=True)]
    assert changed == [True, False]


def test_command_writes_into_the_run_and_names_the_page(city, flexroad):
    said = flexroad("view", city).expected(0)
    assert said.out == f"2 tiles in 3D, 2 more on the map only: {city / 'viewer' / PAGE}\n"
    assert (city / "viewer" / PAGE).exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere"], "nowhere is no run"),
        (["{city}", "--port", "8137"], "--port 8137 is for --serve; add that, or leave out --port"),
        (["{city}", "--tile", "x"], "no tile 'x' in the catalog"),
        (["{city}", "--bbox", "0", "0", "1", "1"], "no tile touches --bbox"),
    ],
)
def test_command_with_bad_input_says_one_line(city, flexroad, words, message):
    said = flexroad("view", *(word.format(city=city) for word in words)).expected(2)
    (line,) = said.errors
    assert message in line


def answer(port, path, host=None):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    connection.request("GET", path, headers={"Host": host or f"127.0.0.1:{port}"})
    return connection.getresponse().status


@pytest.mark.filterwarnings("error")
def test_server_gives_files_of_the_folder_to_this_computer_alone(folder, capfd):
    (folder.parent / "secret.txt").write_text("secret")
    (folder / "link.txt").symlink_to(folder.parent / "secret.txt")
    (folder / "linked").symlink_to(folder.parent)
    (folder / "inside.js").symlink_to("run.js")
    with server(folder, 0) as web:
        thread = threading.Thread(target=web.serve_forever)
        thread.start()
        address, port = web.server_address[:2]
        try:
            assert address == "127.0.0.1"
            assert answer(port, "/") == 200
            assert answer(port, "/run.js", f"localhost:{port}") == 200
            assert answer(port, "/tiles/") == 404
            assert answer(port, "/../secret.txt") == 404
            assert answer(port, "/inside.js") == 200
            for name in ("link.txt", "linked/secret.txt", "%00", "a%00/b", "%2e%2e/secret.txt", "x" * 5000):
                assert answer(port, f"/{name}") == 404, name
            assert answer(port, "/", "evil.example") == 403
        finally:
            web.shutdown()
            thread.join()
    for path in (folder.parent / "secret.txt", folder / "link.txt", folder / "linked", folder / "inside.js"):
        path.unlink()
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.slow
def test_served_folder_is_given_until_ctrl_c(city, tmp_path):
    flexroad = [sys.executable, "-c", "from flexroad.pipeline.cli.main import main; main()"]
    command = [*flexroad, "view", str(city), "-o", str(tmp_path / "page"), "--serve"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        process.stdout.readline()
        port = re.search(r"http://127.0.0.1:(\d+)/", process.stdout.readline())[1]
        assert answer(int(port), "/") == 200
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (0, "stopped\n")
    assert "Traceback" not in err
