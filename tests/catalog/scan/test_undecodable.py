"""Damaged files about which GDAL has a message that is no UTF-8."""

import subprocess
import sys

import pytest

from flexroad.catalog.scan.rasters import quiet

VRT = b"""<VRTDataset rasterXSize="9" rasterYSize="9">
<VRTRasterBand dataType="\xff" band="1"/></VRTDataset>"""
READ = """
import sys, rasterio
from flexroad.catalog.scan.rasters import quiet
try:
    with quiet(), rasterio.open(sys.argv[1]):
        pass
except (rasterio.RasterioIOError, UnicodeDecodeError):
    print("refused")
"""


def test_message_that_is_no_text_prints_nothing(tmp_path):
    (tmp_path / "a.vrt").write_bytes(VRT)
    words = (sys.executable, "-c", READ, tmp_path / "a.vrt")
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("refused\n", "")


def test_other_errors_are_still_printed(monkeypatch):
    seen = []
    monkeypatch.setattr(sys, "unraisablehook", lambda event: seen.append(event.exc_type))
    monkeypatch.setattr(sys, "excepthook", lambda kind, value, trace: seen.append(kind))
    before = sys.unraisablehook, sys.excepthook

    class Fails:
        def __del__(self):
            raise UnicodeDecodeError("utf-8", b"\xff", 0, 1, "no text")

    with quiet(), quiet():
        assert (sys.unraisablehook, sys.excepthook) != before
        Fails()
        sys.excepthook(KeyError, KeyError("a"), None)
        with pytest.raises(UnicodeDecodeError) as error:
            b"\xff".decode()
        sys.excepthook(UnicodeDecodeError, error.value, error.tb)
    assert seen == [UnicodeDecodeError, KeyError, UnicodeDecodeError]
    assert (sys.unraisablehook, sys.excepthook) == before
