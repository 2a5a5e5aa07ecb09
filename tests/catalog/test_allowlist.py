"""A catalog names no file outside its folder that the operator does not allow."""

from datetime import UTC, datetime

import pytest

from flexroad.catalog import Catalog, CatalogError, Grid, Layer, Tile
from flexroad.catalog.allowlist import check_allowed, needed
from flexroad.catalog.tile import LAYERS


def catalog(*files, root) -> Catalog:
    grid = Grid("EPSG:25832", 295500.0, 5629500.0, 1.0, 250, 250)
    return Catalog((Tile("one", grid, (Layer("dsm", files),), str(root), datetime(2020, 5, 1, tzinfo=UTC)),))


@pytest.mark.parametrize(
    ("file", "allow"),
    [
        ("../dsm/a.tif", "{}"),
        ("a/../../b/../dsm/a.tif", "{}"),
        ("/etc/passwd", "/etc"),
        ("/vsicurl/http://169.254.169.254/latest/a.tif", "/vsicurl/http:/169.254.169.254/latest"),
        ("s3://bucket/dsm/a.tif", "s3://bucket/dsm"),
        ("s3:/bucket/my dsm/a.tif", "'s3://bucket/my dsm'"),
    ],
)
def test_a_file_outside_is_refused_and_the_option_named_that_allows_it(tmp_path, file, allow):
    home = tmp_path / "home"
    found = catalog("dsm/in.tif", file, root=home)
    option = f"--allow {allow.format(tmp_path / 'dsm')}"
    with pytest.raises(CatalogError, match="^tile one: dsm names ") as caught:
        check_allowed(found, home)
    assert str(caught.value).endswith(f"if that is meant, add {option}")
    (folder,) = needed(found, home)
    assert folder in option
    check_allowed(found, home, [folder])
    check_allowed(found, home, [folder + "/"])
    with pytest.raises(CatalogError):
        check_allowed(found, home, [folder + "-more"])


@pytest.mark.parametrize("file", ["https://host/a.tif", "file:///etc/passwd", "ftp://host/a", "HTTP:/host/a"])
def test_other_addresses_are_never_read(tmp_path, file):
    for found in (catalog(file, root=tmp_path), catalog("a.tif", root=file)):
        with pytest.raises(CatalogError, match="fetch it first"):
            check_allowed(found, tmp_path, ["/", file])


def test_a_catalog_cannot_say_itself_where_its_folder_is(tmp_path):
    """As the root that a run's own copy names."""
    with pytest.raises(CatalogError, match="--allow /etc"):
        check_allowed(catalog("passwd", root="/etc"), tmp_path)


def test_folders_of_links_stay_usable(tmp_path):
    data, home = tmp_path / "data", tmp_path / "home"
    data.mkdir()
    home.mkdir()
    (home / "dsm").symlink_to(data)
    check_allowed(catalog("dsm/a.tif", root=home), home)
    # By either name of the catalog's own folder.
    (tmp_path / "alias").symlink_to(home)
    check_allowed(catalog("dsm/a.tif", root=home), tmp_path / "alias")
    check_allowed(catalog(f"{tmp_path}/alias/dsm/a.tif", root=home), tmp_path / "alias")


@pytest.mark.slow
def test_a_catalog_in_a_bucket_has_its_folder_there(bucket):
    check_allowed(catalog("dsm/a.tif", root=bucket), bucket)
    for file in ("../a.tif", "../../other/a.tif", "/data/a.tif", f"{bucket}-more/a.tif"):
        with pytest.raises(CatalogError, match="--allow"):
            check_allowed(catalog(file, root=bucket), bucket)


def test_what_needs_to_be_allowed_is_few(tmp_path):
    def asked(*files):
        return needed(catalog(*files, root=tmp_path), tmp_path)

    assert asked("a.tif", "b/c.tif") == ()
    assert asked("/d/dsm/a.tif", "/d/dsm/b/a.tif", "/d/dsm-2/a.tif") == ("/d/dsm", "/d/dsm-2")
    assert asked(*(f"/d/{i}/a.tif" for i in range(9))) == ("/d",)
    assert asked(*(f"/{i}/a.tif" for i in range(9))) == tuple(f"/{i}" for i in range(9))
    assert asked(*(f"s3://b/d/{i}/a.tif" for i in range(9))) == ("s3://b/d",)


def test_what_nobody_reads_may_lie_anywhere(tmp_path):
    found = catalog("/elsewhere/a.tif", root=tmp_path)
    others = set(LAYERS) - {"dsm"}
    check_allowed(found, tmp_path, layers=others)
    assert needed(found, tmp_path, others) == ()
    with pytest.raises(CatalogError, match="--allow /elsewhere"):
        check_allowed(found, tmp_path, layers={"dsm"})
