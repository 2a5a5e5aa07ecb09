"""The picture of the error estimate: the places to look at, and their flags."""

from matplotlib.figure import Figure

from flexroad.catalog import Grid
from flexroad.pipeline.report.estimate_picture import LINE, _circles

GRID = Grid("EPSG:25832", 500_000.0, 5_600_250.0, 1.0, 250, 250)


def labels(places):
    axes = Figure().subplots()
    _circles(axes, GRID, places)
    return {text.get_text(): text.xy for text in axes.texts}


def test_labels_of_near_places_do_not_overlap():
    east, north = 500_120.0, 5_600_140.0
    places = {"spike": (east, north), "patch": (east + 3, north + 1), "loose": (east + 6, north + 3)}
    (_, first), (_, second), (_, third) = (labels(places)[name] for name in places)
    assert first == 140
    assert second - first >= LINE * 250 - 1e-9
    assert third - second >= LINE * 250 - 1e-9


def test_labels_of_far_places_and_flags_of_one_place_stay_where_they_are():
    places = {"spike": (500_020.0, 5_600_100.0), "patch": (500_230.0, 5_600_101.0)}
    assert labels(places) == {"spike": (20, 100), "patch": (230, 101)}
    assert labels(dict.fromkeys(("spike", "patch"), (500_020.0, 5_600_100.0))) == {"spike, patch": (20, 100)}
