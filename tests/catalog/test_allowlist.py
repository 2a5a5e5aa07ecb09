"""Files of a catalog must lie in its folder or in a folder that the user allows."""

from dataclasses import replace
from datetime import UTC, datetime
from itertools import product

import pytest

from flexroad.catalog import Catalog, CatalogError, Grid, Layer, Tile
from flexroad.catalog.index import check_allowed, needed
from flexroad.catalog.tile import LAYERS
from flexroad.catalog.trust import AllowedFolders


def catalog(*files, root) -> Catalog:
    grid = Grid("EPSG:25832", 295500.0, 5629500.0, 1.0, 250, 250)
    return Catalog((Tile("one", grid, (Layer("dsm", files),), str(root), datetime(2020, 5, 1, tzinfo=UTC)),))


def check(made, folder, allow=(), layers=LAYERS):
    allowed = AllowedFolders.of(folder, allow)
    check_allowed(Catalog(tuple(replace(tile, allowed=allowed) for tile in made.tiles)), layers)


@pytest.mark.parametrize(
    ("file", "allow"),
    [
        ("../dsm/a.tif", "{}"),
        ("a/../../b/../dsm/a.tif", "{}"),
        ("/etc/passwd", "/etc"),
        ("s3://bucket/dsm/a.tif", "s3://bucket/dsm"),
        ("S3://bucket/dsm/a.tif", "s3://bucket/dsm"),
        ("s3:/bucket/my dsm/a.tif", "'s3://bucket/my dsm'"),
    ],
)
def test_file_outside_folder_raises_error_with_option(tmp_path, file, allow):
    home = tmp_path / "home"
    tile_catalog = catalog("dsm/in.tif", file, root=home)
    option = f"--allow {allow.format(tmp_path / 'dsm')}"
    with pytest.raises(CatalogError, match="^tile one: dsm names ") as caught:
        check(tile_catalog, home)
    assert str(caught.value).endswith(f"to allow it, begin with flexroad {option}")
    (folder,) = needed(tile_catalog, AllowedFolders.of(home))
    assert folder in option
    check(tile_catalog, home, [folder])
    check(tile_catalog, home, [folder + "/"])
    with pytest.raises(CatalogError):
        check(tile_catalog, home, [folder + "-more"])


@pytest.mark.parametrize(
    "file",
    [
        "https://host/a.tif",
        "file:///etc/passwd",
        "FILE:///etc/passwd",
        "HTTPS://host/a.tif",
        "ftp://host/a",
        "HTTP:/host/a",
        "/vsicurl/http://169.254.169.254/latest/a.tif",
        "/vsis3/bucket/a.tif",
        "/vsistdin/",
    ],
)
def test_other_addresses_are_never_allowed(tmp_path, file):
    for tile_catalog in (catalog(file, root=tmp_path), catalog("a.tif", root=file)):
        with pytest.raises(CatalogError, match="fetch it first"):
            check(tile_catalog, tmp_path, ["/", file])


def test_root_is_not_trusted_and_long_paths_are_cut_in_the_message(tmp_path):
    with pytest.raises(CatalogError, match="--allow /etc"):
        check(catalog("passwd", root="/etc"), tmp_path)
    with pytest.raises(CatalogError, match="a path of 20,0.. characters outside the catalog") as caught:
        check(catalog("/" + "9" * 20_000, root=tmp_path), tmp_path)
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize("file", ["dsm/a.tif", "link.tif", "dsm/../data/a.tif"])
def test_link_in_folder_that_leads_out_needs_allow(tmp_path, file):
    data, home = tmp_path / "data", tmp_path / "home"
    data.mkdir()
    home.mkdir()
    (data / "a.tif").touch()
    (home / "dsm").symlink_to(data)
    (home / "link.tif").symlink_to(data / "a.tif")
    tile_catalog = catalog("inside.tif", file, root=home)
    target = data / file.rpartition("/")[2].replace("link", "a")
    line = f"^tile one: dsm names .*, by a link {target}, outside .*; .* begin with flexroad --allow {data}$"
    with pytest.raises(CatalogError, match=line):
        check(tile_catalog, home)
    assert needed(tile_catalog, AllowedFolders.of(home)) == (str(data),)
    # The folder to allow may be named by a link, too.
    (tmp_path / "alias of data").symlink_to(data)
    for folder in (data, tmp_path / "alias of data"):
        check(tile_catalog, home, [folder])


def test_folder_given_by_a_link_is_the_folder_itself(tmp_path):
    home = tmp_path / "disk" / "home"
    home.mkdir(parents=True)
    (home / "a.tif").touch()
    (home / "b.tif").symlink_to("a.tif")
    (tmp_path / "alias").symlink_to(home)
    (tmp_path / "mounted").symlink_to(tmp_path / "disk")
    names = [home, tmp_path / "alias", tmp_path / "mounted" / "home"]
    for given, root in product(names, names):
        check(catalog("a.tif", "b.tif", f"{root}/a.tif", root=root), given)


@pytest.mark.slow
def test_catalog_in_bucket_allows_only_its_folder(bucket):
    check(catalog("dsm/a.tif", root=bucket), bucket)
    for file in ("../a.tif", "../../other/a.tif", "/data/a.tif", f"{bucket}-more/a.tif"):
        with pytest.raises(CatalogError, match="--allow"):
            check(catalog(file, root=bucket), bucket)


def test_needed_returns_few_folders(tmp_path):
    def folders(*files):
        return needed(catalog(*files, root=tmp_path), AllowedFolders.of(tmp_path))

    assert folders("a.tif", "b/c.tif") == ()
    assert folders("/d/dsm/a.tif", "/d/dsm/b/a.tif", "/d/dsm-2/a.tif") == ("/d/dsm", "/d/dsm-2")
    assert folders(*(f"/d/{i}/a.tif" for i in range(9))) == ("/d",)
    assert folders(*(f"/{i}/a.tif" for i in range(9))) == tuple(f"/{i}" for i in range(9))
    assert folders(*(f"s3://b/d/{i}/a.tif" for i in range(9))) == ("s3://b/d",)


def test_layers_not_read_are_not_checked(tmp_path):
    tile_catalog = catalog("/elsewhere/a.tif", root=tmp_path)
    others = set(LAYERS) - {"dsm"}
    check(tile_catalog, tmp_path, layers=others)
    assert needed(tile_catalog, tmp_path, others) == ()
    with pytest.raises(CatalogError, match="--allow /elsewhere"):
        check(tile_catalog, tmp_path, layers={"dsm"})


def test_paths_of_a_read_catalog_are_checked(tmp_path):
    """`Tile.paths` is the gate: whoever reads a catalog gets no location outside its folder."""
    path = tmp_path / "home" / "catalog.json"
    catalog("dsm/in.tif", "/elsewhere/out.tif", root=path.parent).write(path)
    (tile,) = Catalog.read(path).tiles
    with pytest.raises(CatalogError, match="tile one: dsm names /elsewhere/out.tif.* --allow /elsewhere"):
        tile.paths(tile.layers[0])
    (tile,) = Catalog.read(path, ["/elsewhere"]).tiles
    names = [str(file) for file in tile.paths(tile.layers[0])]
    assert names == [f"{path.parent}/dsm/in.tif", "/elsewhere/out.tif"]
    (tmp_path / "secret.tif").touch()
    (path.parent / "link.tif").symlink_to(tmp_path / "secret.tif")
    catalog("link.tif", root=path.parent).write(path)
    (tile,) = Catalog.read(path).tiles
    with pytest.raises(CatalogError, match=f"by a link {tmp_path}/secret.tif, outside .* --allow {tmp_path}"):
        tile.paths(tile.layers[0])


def test_relative_root_does_not_become_a_prefix_of_gdal(tmp_path, monkeypatch):
    path = tmp_path / "catalog.json"
    catalog("a.tif", root="GTIFF_DIR:1:").write(path, movable=False)
    monkeypatch.chdir(tmp_path)
    (tile,) = Catalog.read(path).tiles
    assert tile.paths(tile.layers[0]) == (tmp_path / "GTIFF_DIR:1:" / "a.tif",)
