import numpy as np

from flexroad.catalog import Grid
from flexroad.tasks.acquire.points.to_rasters import Options, rasterise
from flexroad.tasks.synthetic import SceneOptions, make_scene
from flexroad.tasks.synthetic.points import DECK, GROUND, scan

GRID = Grid("EPSG:25832", 500000, 5600100, 1.0, 100, 100)


def test_scan_has_density_noise_and_classes_of_scene():
    scene = make_scene(GRID, 3, "suburban", SceneOptions(dsm_noise_m=(0.0, 0.0), stream_share=1.0))
    points = scan(scene, per_m2=20, noise_m=0.03)
    assert len(points) == 20 * 100 * 100
    rasters = rasterise(points, GRID, Options(dtm="mean"), None)
    bare = np.isfinite(rasters.dtm) & rasters.ground & (np.abs(scene.dtm - scene.reference) < 0.3)
    off = (rasters.dtm - scene.reference)[bare]
    assert abs(off.mean()) < 0.005
    assert np.median(np.abs(rasters.dsm - scene.dsm - 0.055)) < 0.03
    assert {GROUND, DECK} <= set(np.unique(points.kind))
    assert np.array_equal(scan(scene, 20, 0.03).height, points.height)
    assert not np.array_equal(scan(scene, 20, 0.03, seed=1).height, points.height)
