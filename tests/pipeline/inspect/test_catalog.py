"""A catalog looked over: what is missing, and a photo that lies beside the heights."""

import rasterio
from affine import Affine

from flexroad.catalog import Catalog
from flexroad.pipeline.benchmark.scenes import write_scenes
from flexroad.pipeline.inspect.catalog import check


def test_a_moved_photo_and_a_lost_file_are_told(tmp_path):
    path = write_scenes(tmp_path, 2, seed=3, size_m=120, dop=True)
    assert not any(remark.fault for remark in check(Catalog.read(path)))
    for photo in (tmp_path / "dop").glob("*.tif"):
        with rasterio.open(photo, "r+") as raster:
            raster.transform = Affine.translation(2.0, 0.0) @ raster.transform
    (lost := next((tmp_path / "dtm").glob("*.tif"))).unlink()
    faults = [remark.text for remark in check(Catalog.read(path)) if remark.fault]
    assert any(f"missing: {lost} (1 tile)" in text for text in faults)
    assert any("dop lies 2.0 m east" in text for text in faults)
