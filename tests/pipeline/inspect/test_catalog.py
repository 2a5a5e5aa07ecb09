"""Catalog check: missing files and a photo that is shifted against the heights."""

import rasterio
from affine import Affine

from flexroad.catalog import Catalog
from flexroad.pipeline.benchmark.scenes import write_scenes
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.inspect.catalog import check


def test_check_shifted_photo_and_missing_file_are_faults(tmp_path):
    path = write_scenes(tmp_path, 2, seed=3, size_m=120, dop=True)
    assert not any(finding.fault for finding in check(Catalog.read(path), load_config("production")))
    for photo in (tmp_path / "dop").glob("*.tif"):
        with rasterio.open(photo, "r+") as raster:
            raster.transform = Affine.translation(2.0, 0.0) @ raster.transform
    (missing := next((tmp_path / "dtm").glob("*.tif"))).unlink()
    faults = [
        finding.text for finding in check(Catalog.read(path), load_config("production")) if finding.fault
    ]
    assert any(f"missing: {missing} (1 tile)" in text for text in faults)
    assert any("dop lies 2.0 m east" in text for text in faults)
