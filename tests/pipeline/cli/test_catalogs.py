"""Catalogs of published datasets, made on the command line and run."""

import hashlib
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

import flexroad as library
from flexroad.catalog import Catalog, layouts
from tests.command_line import call
from tests.make_rasters import write


def flexroad(*words, expect: int = 0) -> tuple[str, str]:
    result = call(*words).expected(expect)
    return result.out, result.err


def ground(north: float, west: float) -> np.ndarray:
    rows, columns = np.mgrid[:60, :60]
    return (100 + (north - rows) % 97 * 0.02 + (west + columns) % 89 * 0.01).astype(np.float32)


@pytest.mark.slow
def test_catalog_nrw_can_be_run(tmp_path, quick_config):
    root = tmp_path / "nrw"
    for product in ("dom1", "dgm1"):
        write(root / f"{product}_32_356_5699_1_nw_2020.tif", ground(5700000, 356000), 356000, 5700000)
    road = np.zeros((60, 60), np.uint8)
    road[20:30] = 2
    write(root / "road.tif", road, 356000, 5700000)
    out = tmp_path / "nrw.parquet"
    words = ("--tile-size", 50, "--road-mask", "road.tif", "--road-value", 2, 3, "-o", out)
    out_text, err_text = flexroad("catalog", "nrw", root, *words)
    assert f"1 tile in {out}" in out_text
    assert "note: left out 3 tiles with a DSM height in less than 25%" in err_text
    assert Catalog.read(out).tiles[0].layer("road_mask").values == (2, 3)
    words = ("--config", quick_config, "--catalog", out, "--out", tmp_path / "run", "--executor", "serial")
    assert "1 tile: 1 done" in flexroad("run", *words)[0]
    assert (tmp_path / "run" / "tiles" / "356000_5699950" / "356000_5699950_flexroad.glb").is_file()


def test_next_line_of_catalog_with_own_layout_runs_as_printed(tmp_path, quick_config):
    root = tmp_path / "data"
    for tile, (west, north) in {"295500_5629440": (295500, 5629500), "600_700": (600, 760)}.items():
        for name in ("dom", "dgm"):
            write(root / name / f"{name}_{tile}.tif", ground(north, west), west, north)
        write(root / "mask" / f"{tile}.tif", np.eye(60, dtype=np.uint8), west, north)
    layers = {"dsm": "dom/dom_{tile}.tif", "dtm": "dgm/dgm_{tile}.tif", "road_mask": "mask/{tile}.tif"}
    own = tmp_path / "my layout.yaml"
    own.write_text(yaml.safe_dump(yaml.safe_load(quick_config.read_text()) | {"dataset": {"layers": layers}}))
    for source, notes in (("gerod", "2 of the dataset's 240 tiles"), ("dsc3d", "no reference for")):
        out = tmp_path / f"{source}.json"
        out_text, err_text = flexroad("catalog", source, root, "-o", out, "--layout", own)
        assert f"2 tiles in {out}" in out_text
        assert notes in err_text
        words = shlex.split(out_text.splitlines()[-1].removeprefix("next: flexroad "))
        assert words[:3] == ["run", "--config", str(own)]
        assert "2 tiles: 2 done" in flexroad(*words, "--out", tmp_path / source, "--executor", "serial")[0]


@pytest.mark.slow
def test_production_fits_roads_to_layer_road_height(tmp_path):
    heights = ground(5700000, 356000)
    layers = {"dsm": heights + np.float32(0.1), "dtm": heights, "road_height": heights}
    for name, values in layers.items():
        write(tmp_path / f"{name}.tif", values, 356000, 5700000)
    write(tmp_path / "road.tif", (np.abs(np.arange(60) - 30)[:, None] < 6) * np.ones((60, 60), np.uint8),
          356000, 5700000)  # fmt: skip
    catalog = tmp_path / "catalog.parquet"
    words = [word for name in layers for word in (f"--{name.replace('_', '-')}", f"{name}.tif")]
    flexroad("catalog", "rasters", tmp_path, *words, "--road-mask", "road.tif", "--tile-size", 60,
             "-o", catalog)  # fmt: skip
    for chosen, excess in (("auto", 0.1), ("dsm", 0.0)):
        out = tmp_path / chosen
        flexroad("run", "--config", "production", "--set", f"load.road_height={chosen}",
                 "--catalog", catalog, "--out", out, "--executor", "serial")  # fmt: skip
        row = library.open_run(out).metrics.iloc[0]
        assert row.dsm_excess_m == pytest.approx(excess, abs=1e-4)
        # Without a reference the DTM is the truth.
        assert row.l2_road_m == pytest.approx(0.1 - excess, abs=0.02)


TILE = "295500_5629250"


def gerod_tile(folder: Path) -> None:
    west, south = map(int, TILE.split("_"))
    for name in ("DSM", "DTM"):
        write(folder / f"{TILE}_{name}.tif", ground(south + 60, west), west, south + 60)
    write(folder / f"{TILE}_mask.tif", np.eye(60, dtype=np.uint8), west, south + 60)


def test_catalog_gerod_of_an_archive_unpacks_it_and_says_what_it_found(tmp_path, monkeypatch):
    gerod_tile(tmp_path / "packed")
    archive = Path(shutil.make_archive(str(tmp_path / "GeRoD"), "zip", tmp_path / "packed"))
    out = tmp_path / "gerod.json"
    _, error = flexroad("catalog", "gerod", archive, "-o", out, expect=2)
    *_, line = error.splitlines()
    assert line.startswith(f"error: {archive} has the SHA-256 ")
    assert not (tmp_path / "GeRoD").exists()
    monkeypatch.setattr(layouts, "SHA256", hashlib.sha256(archive.read_bytes()).hexdigest())
    said, error = flexroad("catalog", "gerod", archive, "-o", out)
    assert said.splitlines()[:4] == [
        "layer      tiles  files",
        "dsm            1  {tile}_DSM.tif",
        "dtm            1  {tile}_DTM.tif",
        "road_mask      1  {tile}_mask.tif",
    ]
    assert [line.split(":")[1] for line in said.splitlines() if line.startswith("question")] == [
        f" no reference for 1 of 1 tiles ({TILE})",
        f" no stratum for 1 of 1 tiles ({TILE})",
    ]
    assert f"next: flexroad run --config gerod --catalog {out} --out runs/gerod" in said
    assert f"unpacks to 0.00 GB in {tmp_path / 'GeRoD'}" in error
    (tile,) = Catalog.read(out).tiles
    assert (tile.id, tile.dataset, Path(tile.root)) == (TILE, "GeRoD", tmp_path)
    assert [layer.files for layer in tile.layers] == [
        (f"GeRoD/{TILE}_{n}.tif",) for n in ("DSM", "DTM", "mask")
    ]


def test_init_proposes_the_catalog_of_gerod(tmp_path):
    gerod_tile(tmp_path / "data")
    said, _ = flexroad("init", tmp_path / "data")
    assert said.splitlines()[:2] == ["the paper's dataset GeRoD", "layer      tiles  files"]
    assert said.splitlines()[-1] == f"flexroad catalog gerod {tmp_path / 'data'} -o gerod.parquet"
    assert f"question: no stratum for 1 of 1 tiles ({TILE})" in said
    (tmp_path / "packed").mkdir()
    (tmp_path / "packed" / "GeRoD.zip").touch()
    said, _ = flexroad("init", tmp_path / "packed")
    archive = tmp_path / "packed" / "GeRoD.zip"
    assert said.splitlines()[-1] == f"flexroad catalog gerod {archive} -o gerod.parquet"
    # Other tiles with such ids are not the dataset.
    for path in (tmp_path / "data").iterdir():
        path.rename(path.with_name(path.name.replace(TILE, "295501_5629250")))
    assert "GeRoD" not in flexroad("init", tmp_path / "data")[0]
