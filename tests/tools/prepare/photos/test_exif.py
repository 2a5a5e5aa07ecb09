import io
import subprocess
import sys
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import ExifTags, Image, ImageFile
from pyproj import Transformer

from flexroad.tasks import TaskError, memory
from flexroad.tools.prepare import images
from flexroad.tools.prepare.photos.exif import place_photos, read_control, read_shot
from tests import fuzz, make_photos

XMP = (
    b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    b'<rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" %s/></rdf:RDF></x:xmpmeta>'
)
CENTRE = np.array([*make_photos.CORNER + 30, 140.0])
STEPS = np.array([[0, 0, 0], [10, 0, 0], [0, 10, 1]])


def write(path, tags=None, size=(64, 48), **dji):
    attributes = " ".join(f'drone-dji:{name}="{value}"' for name, value in dji.items())
    more = {"xmp": XMP % attributes.encode()} if dji else {}
    Image.new("RGB", size, (90, 120, 80)).save(path, exif=tags or Image.Exif(), **more)
    return path


def degrees(crs, *place):
    return Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform(*place)


@pytest.fixture
def three(tmp_path):
    return [
        read_shot(write(tmp_path / f"{n}.jpg", make_photos.exif(CENTRE + step)))
        for n, step in enumerate(STEPS)
    ]


def test_place_photos_gives_tagged_positions_in_local_utm_zone(three):
    placed = place_photos(three)
    assert placed.crs == make_photos.CRS
    np.testing.assert_allclose(placed.positions, CENTRE + STEPS, atol=0.001)
    np.testing.assert_array_equal(placed.accuracy[0], [3, 3, 5])
    assert placed.heights == "above mean sea level"
    assert three[0].camera == "Test Made"
    assert three[0].taken == datetime(2024, 5, 17, 10, 30, tzinfo=UTC)


def test_place_photos_to_other_crs_keeps_the_position(three):
    placed = place_photos(three, "EPSG:25833")
    np.testing.assert_allclose(
        degrees("EPSG:25833", *placed.positions[0, :2]), degrees(make_photos.CRS, *CENTRE[:2]), atol=1e-8
    )


@given(st.floats(-179.9, 179.9).filter(lambda degrees: abs(degrees) > 1e-3), st.floats(-80, 80))
@settings(max_examples=40)
def test_read_shot_position_is_right_in_all_hemispheres(longitude, latitude):
    zone = f"+proj=aeqd +lon_0={longitude} +lat_0={latitude}"
    tags = make_photos.exif(CENTRE)
    gps = tags.get_ifd(ExifTags.IFD.GPSInfo)
    for name, value, signs in (("Longitude", longitude, "EW"), ("Latitude", latitude, "NS")):
        gps[getattr(ExifTags.GPS, f"GPS{name}")] = (int(abs(value)), 0, abs(value) % 1 * 3600)
        gps[getattr(ExifTags.GPS, f"GPS{name}Ref")] = signs[value < 0]
    file = io.BytesIO()
    Image.new("L", (16, 16)).save(file, "jpeg", exif=tags)
    shot = read_shot(file)
    offset = Transformer.from_crs("EPSG:4326", zone, always_xy=True).transform(shot.longitude, shot.latitude)
    assert np.hypot(*offset) < 0.2


@pytest.mark.parametrize(
    ("dji", "accuracy", "heights"),
    [
        ({}, (3, 5), "above mean sea level as the drone takes it"),
        ({"RtkFlag": 50}, (0.03, 0.06), "above mean sea level as the drone takes it"),
        (
            {"RtkFlag": 50, "AltitudeType": "RtkAlt"}
            | {"RtkStdLon": 0.011, "RtkStdLat": 0.012, "RtkStdHgt": 0.025},
            (0.012, 0.025),
            "above the WGS 84 ellipsoid",
        ),
        ({"RtkFlag": 0, "RtkStdLon": 0, "RtkStdLat": 0, "RtkStdHgt": 0}, (3, 5), None),
    ],
)
def test_read_shot_prefers_position_in_xmp(tmp_path, dji, accuracy, heights):
    own = {"GpsLatitude": "+50.9962000", "GpsLongitude": "+7.8603000", "AbsoluteAltitude": "+151.20"}
    shot = read_shot(write(tmp_path / "a.jpg", make_photos.exif(CENTRE), **own, **dji))
    assert (shot.latitude, shot.longitude, shot.altitude) == (50.9962, 7.8603, 151.2)
    assert shot.accuracy == accuracy
    assert heights in (None, shot.heights)


@pytest.mark.parametrize(
    ("size", "film_mm", "dji", "focal"),
    [
        # Full frame: 36 mm are the width of the image.
        ((360, 240), 24, {}, 240.0),
        # 4:3 has the diagonal of full frame, 43.27 mm.
        ((400, 300), 20, {}, 20 / np.hypot(36, 24) * 500),
        # 16:9 is cropped from a 3:2 sensor of the same width; portrait orientation is the same.
        ((360, 202), 24, {}, 240.0),
        ((202, 360), 24, {}, 240.0),
        ((360, 240), 24, {"CalibratedFocalLength": "251.5"}, 251.5),
        ((360, 240), None, {}, None),
    ],
)
def test_read_shot_focal_length_is_in_pixels(tmp_path, size, film_mm, dji, focal):
    path = write(tmp_path / "a.jpg", make_photos.exif(CENTRE, film_mm), size, **dji)
    assert read_shot(path).focal_px == pytest.approx(focal)


PLACE = {"GpsLongitude": "8", "GpsLatitude": "50", "AbsoluteAltitude": "100"}


@pytest.mark.parametrize(
    ("dji", "message"),
    [
        ({}, "has no GNSS position.*leave it out"),
        (PLACE | {"AbsoluteAltitude": "1e300"}, "has no GNSS position"),
        (
            PLACE | {"RtkStdLon": "x", "RtkStdLat": "1", "RtkStdHgt": "1"},
            "numbers that cannot be read; leave",
        ),
        (PLACE | {"RtkFlag": "1e3"}, "numbers that cannot be read; leave it out"),
        (PLACE | {"CalibratedFocalLength": "3000 px"}, "numbers that cannot be read; leave it out"),
    ],
)
def test_read_shot_tags_that_cannot_be_used_are_an_error(tmp_path, dji, message):
    with pytest.raises(TaskError, match=rf"indoors\.jpg.* {message}"):
        read_shot(write(tmp_path / "indoors.jpg", **dji))


def test_read_shot_without_a_fix_and_truncated_file_are_errors(tmp_path):
    tags = make_photos.exif(CENTRE)
    path = write(tmp_path / "cut.jpg", tags, (640, 480))
    path.write_bytes(path.read_bytes()[:-1500])
    with pytest.raises(TaskError, match=r"cut\.jpg cannot be read as a photograph"):
        read_shot(path)
    gps = tags.get_ifd(ExifTags.IFD.GPSInfo)
    gps[ExifTags.GPS.GPSLongitude] = gps[ExifTags.GPS.GPSLatitude] = (0, 0, 0)
    with pytest.raises(TaskError, match="no GNSS position"):
        read_shot(write(tmp_path / "a.jpg", tags))


def test_place_photos_that_cannot_be_placed_are_an_error(three, tmp_path):
    far = read_shot(write(tmp_path / "far.jpg", make_photos.exif(CENTRE, offset=(3000, 0, 0))))
    for shots, crs, message in (
        (three[:2], None, "2 photographs are too few"),
        ([*three, far], None, r"2 places more than 1000 m apart.*far\.jpg"),
        (three, "EPSG:4326", "is in degree"),
    ):
        with pytest.raises(TaskError, match=message):
            place_photos(shots, crs)


def test_read_control_groups_by_name_and_transforms(three, tmp_path):
    table = tmp_path / "control.csv"
    east, north = Transformer.from_crs(make_photos.CRS, "EPSG:25833", always_xy=True).transform(*CENTRE[:2])
    table.write_text(
        "image,x_px,y_px,easting,northing,height,name\n"
        f"0.jpg,10.5,20,{east},{north},101.5,A\n1.jpg,30,20,{east},{north},101.5,A\n"
        f"2.jpg,1,2,{east + 5},{north},100,B\n"
    )
    control = read_control(table, place_photos(three), "EPSG:25833")
    assert control.names == ("A", "B")
    np.testing.assert_allclose(control.points[0], [*CENTRE[:2], 101.5], atol=0.001)
    assert control.marks[0] == {three[0].path: (10.5, 20.0), three[1].path: (30.0, 20.0)}


@pytest.mark.parametrize("row", ["9.jpg,1,2,3,4,5", "0.jpg,1,two,3,4,5", "0.jpg,1,2"])
def test_read_control_invalid_row_is_named(three, tmp_path, row):
    table = tmp_path / "control.csv"
    table.write_text(f"image,x_px,y_px,easting,northing,height\n0.jpg,1,2,3,4,5\n{row}\n")
    with pytest.raises(TaskError, match=r"control\.csv, row 2: .*columns are image,x_px"):
        read_control(table, place_photos(three))


def test_read_shot_too_many_pixels_is_an_error_before_they_are_read(tmp_path, monkeypatch):
    paths = [write(tmp_path / f"a.{s}", make_photos.exif(CENTRE), (640, 480)) for s in ("png", "jpg")]
    monkeypatch.setattr(ImageFile.ImageFile, "load", lambda _: pytest.fail("it was decoded"))
    for path in paths:
        monkeypatch.setattr(images, "MOST_PIXELS", 640 * 480 - 2)
        with pytest.raises(TaskError, match=r"a\.... (has|cannot be read).* pixels.*leave it out"):
            read_shot(path)
        monkeypatch.setattr(images, "MOST_PIXELS", 640 * 480)
        monkeypatch.setattr(memory, "limit", lambda: 10**6)
        with pytest.raises(TaskError, match=r"would need about .* of memory.*make it smaller"):
            read_shot(path)


def test_opencv_has_the_same_limit():
    code = "import flexroad.tools.prepare.photos.mvs_cpu, os; print(os.environ['OPENCV_IO_MAX_IMAGE_PIXELS'])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) == images.MOST_PIXELS == 400_000_000


def test_read_shot_extreme_numbers_and_an_altitude_alone_are_not_used(tmp_path):
    odd = {"RtkStdLon": "inf", "RtkStdLat": "1", "RtkStdHgt": "1", "CalibratedFocalLength": "1e300"}
    shot = read_shot(write(tmp_path / "a.jpg", **PLACE, **odd))
    assert (shot.accuracy, shot.focal_px) == ((3, 5), None)
    shot = read_shot(write(tmp_path / "b.jpg", make_photos.exif(CENTRE), AbsoluteAltitude="+151.20"))
    assert shot.altitude == 140.0


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["jpg", "png", "tif"])
def test_read_shot_damaged_at_random_raises_or_reads(tmp_path, suffix):
    path = write(tmp_path / f"a.{suffix}", make_photos.exif(CENTRE))
    fuzz.check(
        "flexroad.tools.prepare.photos.exif", "read_shot", fuzz.damaged(path.read_bytes(), 200, 1), path
    )
