"""The fit of production on real tiles against a literal computation with a direct solver, within 1 mm."""

import zipfile

import numpy as np
import pytest

from flexroad.catalog.sources.rasters import index
from flexroad.tasks.filter import planar
from flexroad.tasks.fit import smoothing_spline
from flexroad.tasks.load import Options, load
from flexroad.tasks.segment import mask
from tests import exact_fit

pytestmark = [pytest.mark.real, pytest.mark.slow]


@pytest.mark.parametrize("number", range(9))
def test_fit_of_barbican_equals_literal_fit(real_data, tmp_path, monkeypatch, number):
    with zipfile.ZipFile(real_data / "umep" / "London_BNG.zip") as archive:
        archive.extractall(tmp_path)
    layers = {"dsm": "dsm_barb*.tif", "dtm": "dem_barb*.tif", "road_mask": "landcover*.tif"}
    data = load(index(tmp_path / "London_BNG", layers, road_values=(1,)).tiles[number], Options())
    clusters = planar.ecsrc(data, mask.segment(data, mask.Options()), planar.Options(shoulder_m=5))
    surfaces = []
    for literal in (False, True):
        if literal:
            monkeypatch.setattr(smoothing_spline, "_minimum", exact_fit.minimum)
        surface = smoothing_spline.fit(data, clusters, smoothing_spline.Options())
        surfaces.append(surface.lattice(data.core.eastings, data.core.northings))
    # Beyond the survey there is nothing to hold the surface.
    near = np.isfinite(data.dsm)[data.grid.window(data.core)]
    assert np.abs(surfaces[0] - surfaces[1])[near].max() < 1e-3
