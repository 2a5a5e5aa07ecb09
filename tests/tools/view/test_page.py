"""The viewer's page in Chromium, from file://: no request, no error; it shows what the run has."""

import base64
import io

import numpy as np
import pytest
from PIL import Image

import flexroad
from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.tasks.quality.assess import LIMITS
from flexroad.tasks.spline.stepped import without_steps
from flexroad.tools.export.source import select
from flexroad.tools.synthetic.scenes import write_scenes
from flexroad.tools.view import encoding as viewer
from flexroad.tools.view.driver import DONE, FAILED, PENDING, built_files, write_viewer
from tests.validators.pages import browse, visit

pytestmark = [pytest.mark.slow, pytest.mark.soak("pages")]

SETTLED = "() => { const now = FLEXROAD.inspect(); return now.loaded.length > 0 && now.loading === 0 }"
MIDDLE = [200, 90, 420, 450]
"""A part of the default page without its panels: x, y, width and height (pixels)."""
AGREED_M = 0.015
HIT = "<img src=x onerror='window.hit = 1'><script>window.hit = 1</script>"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of four tiles of 60 m with orthophotos and road lines, one of them not computed."""
    folder = tmp_path_factory.mktemp("page")
    catalog = Catalog.read(write_scenes(folder / "survey", 4, seed=5, size_m=60, dop=True))
    run = Run.create(folder / "city", load_config("production"), catalog)
    run_tiles(run, SerialExecutor(), only=lambda tile: tile != catalog.tiles[3])
    return run


@pytest.fixture(scope="module")
def page(run, tmp_path_factory):
    out = tmp_path_factory.mktemp("built")
    return write_viewer(Run.open(run.path), out, SerialExecutor()).page


def picture(png):
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB"), int)


def made(folder, ids, states, errors=None):
    """A viewer's folder of synthetic tiles of 100 m, without their scripts."""
    number = len(ids)
    side = int(np.ceil(np.sqrt(number)))
    tiles = {
        "id": ids,
        "file": [f"t{i}" for i in range(number)],
        "west": [500000 + 100.0 * (i % side) for i in range(number)],
        "south": [5600000 + 100.0 * (i // side) for i in range(number)],
        "width": [100.0] * number,
        "height": [100.0] * number,
        "state": states,
        "stale": [False] * number,
        "flags": [[] for _ in ids],
        "places": [{} for _ in ids],
        "error": errors or [""] * number,
        "measures": {"error_estimate_m": [0.001 * (i % 97) for i in range(number)]},
    }
    index = {
        "name": "made",
        "crs_name": "EPSG:25832",
        "vertical": None,
        "origin": [500000, 5600000],
        "measures": {"error_estimate_m": {"title": "Error estimate", "unit": "m"}},
        "tiles": tiles,
    }
    for file in built_files():
        (folder / file.name).write_bytes(file.read_bytes())
    (folder / viewer.NAME_RUN).write_bytes(viewer.encode_run(index))
    return folder / "index.html"


READOUT = "({...document.getElementById('readout').dataset})"
INSPECT = "FLEXROAD.inspect()"


def pixel_of(box, easting, northing):
    """The pixel of a place on the overview map."""
    x = box["width"] / 2 + (easting - box["easting"]) * box["scale"]
    return [x, box["height"] / 2 - (northing - box["northing"]) * box["scale"]]


def test_click_on_the_map_opens_the_tile_and_its_neighbours_and_back_and_escape_return(run, page):
    (box,) = browse(page, {"eval": f"{INSPECT}.box"})
    tile = run.catalog.tiles[0]
    west, south, east, north = tile.grid.bounds
    results = browse(
        page,
        {"eval": INSPECT},
        {"click": pixel_of(box, (west + east) / 2, (south + north) / 2)},
        {"wait": "() => FLEXROAD.inspect().loaded.length === 3"},
        {"eval": INSPECT},
        {"eval": "location.hash"},
        {"key": "ArrowUp"},
        {"key": "ArrowUp"},
        {"eval": "history.back()"},
        {"wait": f"() => {INSPECT}.view === 'map'"},
        {"eval": "history.forward()"},
        {"wait": f"() => {INSPECT}.view === 'tile'"},
        {"eval": f"{INSPECT}.tile"},
        {"key": "Escape"},
        {"eval": INSPECT},
    )
    before, opened, link, again, after = (results[step] for step in (0, 3, 4, 11, 13))
    assert (before["view"], before["loaded"]) == ("map", [])
    assert (opened["view"], opened["tile"]) == ("tile", tile.id)
    assert set(opened["loaded"]) == {tile.id for tile in run.catalog.tiles[:3]}
    assert f"tile={tile.id}" in link
    assert again == tile.id
    assert (after["view"], after["loaded"]) == ("map", [])


def test_picked_heights_are_those_of_the_surface(run, page):
    tile = run.catalog.tiles[0]
    places = [[x, y] for x in range(230, 630, 65) for y in range(180, 580, 60)]
    steps = [step for place in places for step in ({"move": place}, {"eval": READOUT})]
    found = browse(page, {"wait": SETTLED}, *steps, fragment=f"#tile={tile.id}")[2::2]
    picked = [shown for shown in found if shown.get("tile")]
    surfaces = {tile.id: tile.surface for tile in select(run.path).finished()}
    roads = 0
    for shown in picked:
        x, y = np.array([[float(shown["easting"])], [float(shown["northing"])]])
        surface = surfaces[shown["tile"]]
        (height,) = surface.height(x, y)
        rounding = 1e-6 if height == without_steps(surface).height(x, y) else viewer.STEP_M
        assert abs(float(shown["height"]) - height) < rounding
        if shown["kind"] == "road":
            roads += 1
            assert abs(float(shown["drawn"]) - height) < AGREED_M
    assert len(picked) > 25
    assert roads > 5


def test_link_restores_camera_and_layers(run, page):
    fragment = f"#tile={run.catalog.tiles[0].id}"
    first = browse(
        page,
        {"wait": SETTLED},
        {"drag": [400, 350, 460, 310]},
        {"press": "input[name=terrain]"},
        {"press": "[data-key=support]"},
        {"wait": "() => location.hash.includes('hide=terrain')"},
        {"shot": MIDDLE},
        {"eval": "location.hash"},
        {"eval": INSPECT},
        fragment=fragment,
    )
    second = browse(page, {"wait": SETTLED}, {"shot": MIDDLE}, {"eval": INSPECT}, fragment=first[-2])
    assert second[-1]["look"] == first[-1]["look"]
    np.testing.assert_allclose(second[-1]["camera"], first[-1]["camera"], rtol=0, atol=0.2)
    assert np.abs(picture(second[-2]) - picture(first[-3])).mean() < 12


def test_each_setting_changes_the_picture(run, page):
    switches = [
        "[data-key=class]",
        "[data-key=support]",
        "[data-key=estimate]",
        "[data-key=photo]",
        "input[name=wire]",
        "input[name=points]",
        "input[name=terrain]",
        "input[name=road]",
    ]
    steps = [step for switch in switches for step in ({"press": switch}, {"shot": MIDDLE})]
    stretch = (
        "(() => { const z = document.querySelector('[name=z]');"
        " z.value = 4; z.dispatchEvent(new Event('input')) })()"
    )
    results = browse(
        page,
        {"wait": SETTLED},
        {"wait": "() => FLEXROAD.inspect().look.colour === 'photo'"},
        {"shot": MIDDLE},
        *steps,
        {"press": "input[name=road]"},
        {"press": "input[name=terrain]"},
        {"shot": MIDDLE},
        {"eval": stretch},
        {"shot": MIDDLE},
        fragment=f"#tile={run.catalog.tiles[0].id}",
    )
    shots = [picture(result) for result in results if isinstance(result, str)]
    assert len(shots) == len(switches) + 3
    for name, before, after in zip([*switches, "both classes", "heights"], shots, shots[1:], strict=False):
        assert (np.abs(after - before).max(axis=2) > 20).mean() > 0.01, name
    # Back at the photo, it is the same picture.
    assert np.abs(shots[4] - shots[0]).mean() < 1
    # Without road and terrain only points are left.
    sky = np.median(shots[8], axis=(0, 1))
    assert np.median(np.abs(shots[8] - sky)) < 10 < np.median(np.abs(shots[6] - sky))


def test_section_between_two_clicks_has_the_heights_of_the_run(run, page):
    table = (
        "(() => { let csv; HTMLAnchorElement.prototype.click = function () { csv = this.href; };"
        " document.getElementById('section-save').click();"
        " return decodeURIComponent(csv.split(',').slice(1).join(',')) })()"
    )
    results = browse(
        page,
        {"wait": SETTLED},
        {"press": "[data-tool=measure]"},
        {"click": [260, 330]},
        {"click": [520, 350]},
        {"wait": "() => document.querySelector('#chart path.surface')"},
        {"eval": table},
        {"eval": "document.getElementById('section-text').textContent"},
        {"press": "#section-close"},
        {"eval": "document.getElementById('section').hidden"},
        fragment=f"#tile={run.catalog.tiles[0].id}",
    )
    head, *rows = results[5].strip().splitlines()
    assert head == "distance_m,easting,northing,surface_m,dsm_m,dtm_m"
    values = np.array([[float(cell or "nan") for cell in row.split(",")] for row in rows])
    assert len(values) > 50
    distance, x, y, surface, dsm, dtm = values.T
    assert np.allclose(np.hypot(x - x[0], y - y[0]), distance, atol=0.01)
    expected = np.full(len(x), np.nan)
    for tile in select(run.path).finished():
        west, south, east, north = tile.graph.tile.grid.bounds
        inside = (west <= x) & (x <= east) & (south <= y) & (y <= north)
        expected[inside] = tile.surface.height(x[inside], y[inside])
    np.testing.assert_allclose(surface, expected, rtol=0, atol=0.002)
    assert np.median(np.abs(dtm - surface)) < 0.2
    assert np.isfinite(dsm).all()
    assert f"{distance[-1]:.1f} m, rises" in results[6]
    assert results[8] is True


def test_drive_moves_the_camera_along_the_road_just_above_it(run, page):
    results = browse(
        page,
        {"wait": SETTLED},
        {"press": "[data-tool=drive]"},
        {
            "wait": "() => { window.start ??= FLEXROAD.inspect().camera; const now = FLEXROAD.inspect();"
            " return !now.driving || Math.hypot(now.camera[0] - start[0], now.camera[1] - start[1]) > 8 }"
        },
        {"eval": INSPECT},
        {"key": "Escape"},
        {"eval": INSPECT},
        fragment=f"#tile={run.catalog.tiles[0].id}",
    )
    driving, after = results[3], results[5]
    assert driving["lines"] > 0
    easting, northing, height = driving["camera"][:3]
    heights = [
        float(tile.surface.height(np.array([easting]), np.array([northing]))[0])
        for tile in select(run.path).finished()
        if tile.graph.tile.grid.west <= easting <= tile.graph.tile.grid.bounds[2]
        and tile.graph.tile.grid.bounds[1] <= northing <= tile.graph.tile.grid.north
    ]
    assert 1.4 < height - heights[0] < 3.5
    assert (after["view"], after["driving"]) == ("tile", False)


def test_phone_shows_settings_and_readout_by_taps_and_closes_the_settings_for_a_section(run, page):
    display = {"eval": "getComputedStyle(document.getElementById('panel-content')).display"}
    results = browse(
        page,
        {"wait": SETTLED},
        display,
        {"tap": [195, 420]},
        {"eval": READOUT},
        {"press": "#panel-toggle"},
        display,
        {"eval": "document.documentElement.scrollWidth"},
        {"press": "#panel-content button[data-tool=measure]"},
        display,
        {"eval": "document.getElementById('hint').textContent"},
        fragment=f"#tile={run.catalog.tiles[0].id}",
        width=390,
        height=844,
    )
    assert results[1] == "none"
    assert results[3]["tile"]
    assert results[5:7] == ["block", 390]
    assert results[8:] == ["none", "Choose where the section begins."]


def test_phone_zooms_by_two_fingers_on_the_map_and_in_a_tile(run, page):
    phone = {"width": 390, "height": 844}
    steps = [{"eval": f"{INSPECT}.box"}, {"pinch": [195, 420, 50, 100]}, {"eval": INSPECT}]
    before, _, after = browse(page, *steps, **phone)
    assert after["view"] == "map"
    assert after["box"]["scale"] == pytest.approx(2 * before["scale"], rel=0.02)
    away = {"eval": "(([x, y, z, e, n, h]) => Math.hypot(x - e, y - n, z - h))(FLEXROAD.inspect().camera)"}
    link = f"#tile={run.catalog.tiles[0].id}"
    _, far, _, near = browse(
        page, {"wait": SETTLED}, away, {"pinch": [195, 420, 50, 100]}, away, fragment=link, **phone
    )
    assert near < 0.8 * far


@pytest.mark.parametrize(("width", "height"), [(1400, 900), (1000, 640), (390, 844), (844, 390)])
def test_first_view_has_the_whole_tile_beside_the_settings(run, page, width, height):
    link = f"#tile={run.catalog.tiles[0].id}"
    size = {"width": width, "height": height}
    _, seen = browse(page, {"wait": SETTLED}, {"eval": INSPECT}, fragment=link, **size)
    for x, y in seen["corners"]:
        assert 0 < x < seen["free"]
        assert 0 < y < height
    assert (seen["free"] < width) == (width > 900)
    spans = np.ptp(np.array(seen["corners"]), axis=0) / [seen["free"], height]
    assert spans.max() > 0.5


@pytest.fixture(scope="module")
def flagged(run, tmp_path_factory):
    """The page of a run with one flagged tile, this tile, and the place of its flag."""
    folder = tmp_path_factory.mktemp("flagged")
    flagging = Run.create(folder / "run", load_config("production"), run.catalog)
    tile = run.catalog.tiles[0]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(LIMITS, "error-estimate", 1e-6)
        run_tiles(flagging, SerialExecutor(), only=lambda one: one == tile)
    (finished,) = select(flagging.path).finished()
    return (
        write_viewer(Run.open(flagging.path), folder / "page", SerialExecutor()).page,
        tile,
        finished.flag_places["error-estimate"],
    )


def test_places_of_flags_are_marked_and_a_click_on_map_list_or_tile_goes_there(flagged):
    page, tile, place = flagged
    (box,) = browse(page, {"eval": f"{INSPECT}.box"})
    target = {"eval": f"{INSPECT}.camera.slice(3, 5)"}
    pixel = pixel_of(box, *place)
    by_map = browse(
        page,
        {"move": pixel},
        {"eval": "document.getElementById('tip').textContent"},
        {"click": pixel},
        {"wait": SETTLED},
        target,
    )
    assert "here: the surface is far from scan and terrain model on average" in by_map[1]
    assert by_map[-1] == pytest.approx(place, abs=0.1)
    by_list = browse(page, {"press": ".list button.place"}, {"wait": SETTLED}, target)
    assert by_list[-1] == pytest.approx(place, abs=0.1)
    _, before, _, after = browse(
        page,
        {"wait": SETTLED},
        target,
        {"press": "#panel-content button.place"},
        target,
        fragment=f"#tile={tile.id}",
    )
    assert np.hypot(*np.subtract(before, place)) > 1
    assert after == pytest.approx(place, abs=0.1)


def test_outline_of_the_tile_lies_on_the_surface_and_goes_with_the_tile(flagged):
    page, tile, _ = flagged
    _, around, _, on_map = browse(
        page,
        {"wait": SETTLED},
        {"eval": f"{INSPECT}.outline"},
        {"key": "Escape"},
        {"eval": f"{INSPECT}.outline"},
        fragment=f"#tile={tile.id}",
    )
    assert on_map is None
    x, y, z = np.array(around).T
    west, south, east, north = tile.grid.bounds
    to_edge = np.min([x - west, east - x, y - south, north - y], axis=0)
    np.testing.assert_allclose(to_edge, 0.05, rtol=0, atol=1e-6)
    assert (np.ptp(x), np.ptp(y)) == pytest.approx((east - west - 0.1, north - south - 0.1), abs=1e-6)
    (finished,) = select(page.parent.parent / "run").finished()
    np.testing.assert_allclose(z, finished.surface.height(x, y), rtol=0, atol=viewer.STEP_M)


def test_unknown_tile_in_the_address_is_named_and_enter_opens_the_first_tile_that_is_found(run, page):
    search = "#panel-content input[type=search]"
    typed = (
        f"(e => {{ e.value = '_'; e.dispatchEvent(new Event('input')) }})(document.querySelector('{search}'))"
    )
    _, text, view, *_, opened = browse(
        page,
        {"wait": "() => window.FLEXROAD.inspect"},
        {"eval": "document.getElementById('panel-content').textContent"},
        {"eval": f"{INSPECT}.view"},
        {"eval": typed},
        {"focus": search},
        {"key": "Enter"},
        {"wait": SETTLED},
        {"eval": f"{INSPECT}.tile"},
        fragment="#tile=nope",
    )
    assert "This run has no tile nope." in text
    assert view == "map"
    assert opened == run.catalog.tiles[0].id


def test_ten_thousand_tiles_are_drawn_and_coloured_by_a_measure(tmp_path):
    ids = [f"tile {i}" for i in range(10_000)]
    page = made(tmp_path, ids, [FAILED if i % 10 == 0 else DONE for i in range(10_000)])
    choose = (
        "(() => { const by = document.querySelector('#panel-content select'); by.value = 'error_estimate_m';"
        " by.dispatchEvent(new Event('change')) })()"
    )
    results = browse(
        page,
        {"shot": MIDDLE},
        {"eval": choose},
        {"shot": MIDDLE},
        {"eval": "document.getElementById('summary').textContent"},
        {"eval": "location.hash"},
    )
    states, measure = (np.unique(picture(results[i]).reshape(-1, 3), axis=0) for i in (0, 2))
    assert len(states) >= 2
    assert len(measure) > 50
    assert results[3] == "10\u202f000 tiles: 9000 done, 1000 failed"
    assert results[4] == "#by=error_estimate_m"


def test_tile_without_its_file_is_named_and_the_map_stays(tmp_path):
    page = made(tmp_path, ["a", "b"], [DONE, PENDING])
    answer = visit(
        page,
        {"wait": "() => document.getElementById('hint').textContent"},
        {"eval": "document.getElementById('hint').textContent"},
        {"key": "Escape"},
        {"eval": "FLEXROAD.inspect().view"},
        fragment="#tile=a",
    )
    assert "tiles/t0.js is missing or damaged" in answer["results"][1]
    assert answer["results"][3] == "map"
    assert answer["requests"] == []


def test_markup_in_ids_and_errors_is_text(tmp_path):
    page = made(tmp_path, [HIT, "b"], [FAILED, DONE], [HIT, ""])
    results = browse(
        page,
        {"move": [200, 300]},
        {"press": ".list button"},
        {"eval": "document.getElementById('app').textContent"},
        {"eval": "[window.hit === undefined, document.querySelectorAll('#app img, #app script').length]"},
    )
    assert results[2].count(HIT) >= 2
    assert results[3] == [True, 0]


@pytest.mark.parametrize("missing", ["run.js", "viewer.js"])
def test_folder_without_a_script_says_so(tmp_path, missing):
    page = made(tmp_path, ["a"], [DONE])
    (tmp_path / missing).unlink()
    answer = visit(page, {"eval": "document.body.innerText"})
    (text,) = answer["results"]
    assert "run.js" in text
    assert "flexroad view" in text
    assert answer["requests"] == []


def test_decks_are_hidden_by_a_key_and_a_drive_stays_on_its_level(tmp_path):
    catalog = Catalog.read(write_scenes(tmp_path / "survey", 4, seed=0, size_m=60, decks=True))
    run = Run.create(tmp_path / "run", load_config("production_vector", ["segment.levels=true"]), catalog)
    run_tiles(run, SerialExecutor())
    page = write_viewer(run, tmp_path / "viewer", SerialExecutor()).page
    tiles = select(run.path).finished()
    tile = next(tile for tile in tiles if 1 in tile.mesh.numbers)
    x, y = np.meshgrid(tile.tile.grid.eastings, tile.tile.grid.northings)
    rise = np.where(
        tile.surface.covers(1, x, y), tile.surface.at(1).height(x, y) - tile.surface.height(x, y), 0
    )
    highest = np.unravel_index(rise.argmax(), rise.shape)
    east, north = x[highest], y[highest]
    deck = tile.surface.at(1).height(east, north)
    camera = f"&camera={east:.1f},{north - 9:.1f},{deck + 40:.1f},{east:.1f},{north:.1f},{deck:.1f}"
    middle = [(1000 - 330) / 2, 320]
    card = "document.getElementById('readout')"
    shown = f"({{...{card}.dataset, text: {card}.innerText}})"
    checks = "[...document.querySelectorAll('#panel-content label')].map((one) => one.innerText.trim())"
    _, around, names, _, above, _, _, below, _, _, _, driven = browse(
        page,
        {"wait": SETTLED},
        {"eval": f"{INSPECT}.outline"},
        {"eval": checks},
        {"move": middle},
        {"eval": shown},
        {"key": "l"},
        {"move": [middle[0] + 1, middle[1]]},
        {"eval": shown},
        {"key": "l"},
        {"key": "d"},
        {"wait": f"() => {card}.innerText.includes('Grade')"},
        {"eval": shown},
        fragment=f"#tile={tile.id}{camera}",
    )
    assert "Decks and tunnels" in names
    heights = flexroad.open_run(run.path).height
    x, y, z = np.array(around).T
    off = np.abs(z - heights(x, y))
    # The mesh is steep where the surface has steps.
    assert (np.median(off) < 0.05, off.max() < 3) == (True, True)
    assert {"Level 0", "Level 1"} <= set(above["text"].splitlines())
    assert float(above["height"]) - float(below["height"]) > 0.7 * rise.max()
    places = np.array([[float(driven["easting"])], [float(driven["northing"])]])
    assert abs(float(driven["height"]) - heights(*places)[0]) < 0.1
