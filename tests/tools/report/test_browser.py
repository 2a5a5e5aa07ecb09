"""The report in a browser: the map answers to the mouse and the keyboard, and nothing is requested."""

import base64
import io

import numpy as np
import pytest
from PIL import Image

from flexroad.tools.report.browser.page import html_page
from tests.made_report import failed_row, made_content, made_row, made_run, many_rows
from tests.validators.pages import visit

pytestmark = [pytest.mark.slow, pytest.mark.soak("pages")]

EVIL = "<script>document.title='evil'</script><b>x</b>"
SELECTED = {"eval": "document.querySelector('#tile h3')?.textContent ?? ''"}
PIXELS = {"eval": "document.getElementById('map').toDataURL('image/png')"}
MOST_BYTES = 15_000_000
MANY = [f"{588000 + 250 * (i % 100)}_{5519000 + 250 * (i // 100)}" for i in range(10_000)]


def shown(file, *steps, width=1400, scheme="light", place=""):
    """Return the results of the steps on a page; it has no error, requests nothing and fits the window."""
    said = visit(file, *steps, fragment=place, width=width, height=900, dark=scheme == "dark")
    assert said["requests"] == []
    assert said["errors"] == []
    assert not said["wide"]
    return said["results"]


def pixels(address):
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(address.split(",")[1]))).convert("RGB")).astype(
        int
    )


@pytest.fixture(scope="module")
def small(tmp_path_factory, made_survey):
    """A page of 2 x 2 tiles: from the south-west a fine, a flagged, a failed and a pending one."""
    folder = tmp_path_factory.mktemp("small")
    run = made_run(folder / "RUN", made_survey / "catalog.parquet", ["a", EVIL, "c", "d"])
    rows = [
        made_row("a", 0.02, l2_road_m=0.5),
        made_row(EVIL, 0.3, "error-estimate, spike", l2_road_m=0.1),
        failed_row("c", f"load: TaskError: {EVIL} is missing"),
    ]
    file = folder / "report.html"
    file.write_text(html_page(run, made_content(run, rows), "view/index.html"))
    return file


@pytest.fixture(scope="module")
def large(tmp_path_factory, made_survey):
    folder = tmp_path_factory.mktemp("large")
    run = made_run(folder / "RUN", made_survey / "catalog.parquet", MANY)
    file = folder / "report.html"
    file.write_text(html_page(run, made_content(run, list(many_rows(MANY)))))
    return file


def test_click_and_arrow_keys_select_tiles_and_markup_is_text(small):
    # The map is square and its tiles are 2 x 2 around the middle.
    middle = "(c => [c.clientWidth / 2, c.clientHeight / 2])(document.getElementById('map'))"
    ((x, y),) = shown(small, {"eval": middle})
    results = shown(
        small,
        SELECTED,
        {"press": ["#map", x - 60, y + 60]},
        SELECTED,
        {"key": "ArrowRight"},
        SELECTED,
        {"eval": "document.getElementById('tile').textContent"},
        {"eval": "document.querySelector('#tile .links a').getAttribute('href')"},
        {"key": "ArrowUp"},
        SELECTED,
        {"key": "ArrowLeft"},
        {"eval": "document.querySelector('#tile .error').textContent"},
        {"key": "Escape"},
        SELECTED,
        {"eval": "[document.title, location.hash]"},
    )
    before, _, south_west, _, south_east, details, link, _, north_east, _, error, _, after, ends = results
    assert (before, south_west, south_east, north_east, after) == ("", "a", EVIL, "d", "")
    assert "the surface bends more than a road can (0.31 1/m, limit 0.2 1/m)" in details
    assert link.startswith("view/index.html#tile=%3Cscript%3E")
    assert error == f"load: TaskError: {EVIL} is missing"
    assert ends == ["FlexRoad: invented over 4 tiles", ""]


def test_address_and_list_select_tiles(small):
    press = "[...document.querySelectorAll('.look button[data-tile]')].at(-1).click()"
    assert shown(small, SELECTED, place="#tile=c")[0] == "c"
    assert shown(small, {"eval": press}, SELECTED) == [None, "a"]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_colour_by_column_and_legend_change_the_pixels(small, scheme):
    by = {"select": ["#colour-by", "error_estimate_m"]}
    hide = {"press": "#legend button"}
    states, _, estimates, _, _, hidden = shown(
        small, PIXELS, by, PIXELS, {"select": ["#colour-by", "state"]}, hide, PIXELS, scheme=scheme
    )
    shapes = {pixels(picture).shape for picture in (states, estimates, hidden)}
    assert len(shapes) == 1
    of_states, of_estimates, of_hidden = (pixels(picture) for picture in (states, estimates, hidden))
    height, width, _ = of_states.shape
    south_west, south_east = (height // 2 + 60, width // 2 - 60), (height // 2 + 60, width // 2 + 60)
    for place in (south_west, south_east):
        assert np.abs(of_states[place] - of_estimates[place]).max() > 20
    # In both, a fine and a flagged tile differ; a hidden state has no colour.
    assert np.abs(of_states[south_west] - of_states[south_east]).max() > 40
    assert np.abs(of_estimates[south_west] - of_estimates[south_east]).max() > 40
    assert np.abs(of_states[south_west] - of_hidden[south_west]).max() > 20
    assert (of_states[south_east] == of_hidden[south_east]).all()


def test_tables_sort_by_click_and_key(small):
    first = {"eval": "[...document.querySelectorAll('#tile-list tbody tr')].map(r => r.cells[0].textContent)"}
    column = "#tile-list th:nth-child(5) button"
    opened = {"eval": "document.getElementById('all-tiles').open = true"}
    _, _, highest, _, lowest, _, _, by_name = shown(
        small, opened, {"press": column}, first, {"key": "Enter"}, first,
        {"focus": "#tile-list th:first-child button"}, {"key": "Enter"}, first,
    )  # fmt: skip
    # Road error: a 0.5, the other 0.1; the others have none and stay at the end.
    assert highest == ["a", EVIL, "c", "d"]
    assert lowest == [EVIL, "a", "c", "d"]
    assert by_name == sorted([EVIL, "a", "c", "d"], key=lambda name: name.lower())


@pytest.mark.parametrize(("width", "scheme"), [(1400, "dark"), (390, "light"), (390, "dark")])
def test_page_fits_windows_of_all_sizes(small, width, scheme):
    heading = shown(small, {"eval": "document.querySelector('h2').textContent"}, width=width, scheme=scheme)
    assert heading == ["Did it work?"]


def test_ten_thousand_tiles_open_and_are_found(large):
    assert large.stat().st_size < MOST_BYTES
    rows = {"eval": "document.querySelectorAll('#tile-list tbody tr').length"}
    found = {"eval": "document.querySelector('#tile-list tbody tr').cells[0].textContent"}
    search = {
        "eval": f"(i => {{ i.value = '{MANY[4321]}'; i.dispatchEvent(new Event('input')); }})"
        "(document.querySelector('#tile-list input'))"
    }
    opened = {"eval": "document.getElementById('all-tiles').open = true"}
    wait = {"key": "Shift"}
    results = shown(large, SELECTED, opened, wait, rows, search, found, PIXELS, place=f"#tile={MANY[5000]}")
    assert results[0] == MANY[5000]
    assert results[3] == 100
    assert results[5] == MANY[4321]
    assert len(np.unique(pixels(results[6]).reshape(-1, 3), axis=0)) > 4


def test_failed_tiles_only_and_one_tile_open(tmp_path, made_survey):
    for number, ids in enumerate((["a", "b", "c"], ["a"])):
        run = made_run(tmp_path / f"RUN{number}", made_survey / "catalog.parquet", ids)
        file = tmp_path / f"{number}.html"
        file.write_text(html_page(run, made_content(run, [failed_row(name, "load: x: y") for name in ids])))
        answer, _, selected = shown(
            file, {"eval": "document.querySelector('.answer').textContent"}, {"focus": "#map"}, SELECTED
        )
        assert answer.startswith("No: no tile is done")
        assert selected == ""
