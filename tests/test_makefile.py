"""The commands of `make reproduce`."""

import shutil
import subprocess
from pathlib import Path

import pytest

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed"),
]

ROOT = Path(__file__).parent.parent


def commands(tmp_path, *words: str) -> list[list[str]]:
    """Return the words of each call of flexroad in a fresh, installed checkout."""
    shutil.copy(ROOT / "Makefile", tmp_path)
    for name in ("pyproject.toml", "constraints.txt", ".venv/.installed", "configs/gerod.yaml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    make = ["make", "-n", "reproduce", *words]
    done = subprocess.run(make, cwd=tmp_path, capture_output=True, text=True, check=True)
    lines = [line.split() for line in done.stdout.splitlines()]
    return [line[1:] for line in lines if line[0].endswith("flexroad")]


def test_reproduce_synthetic_tiles_run_with_both_masks(tmp_path):
    catalog, _, first, second, dsm, literal, _, _, tables, figures = commands(tmp_path, "TILES=3", "SEED=5")
    assert catalog[:2] == ["catalog", "synthetic"]
    assert {"--preset", "gerod", "--tiles", "3", "--seed", "5"} <= set(catalog)
    stores = {line[line.index("--store") + 1] for line in (first, second, dsm, literal)}
    assert len(stores) == 1
    runs = (first, second, dsm, literal)
    configs = [line[line.index("--config") + 1] for line in runs]
    assert configs == ["ablation", "ablation_true", "ablation_dsm", "literal"]
    catalogs = [Path(line[line.index("--catalog") + 1]) for line in (first, second, dsm)]
    assert catalogs[1] == catalogs[0].with_name("catalog_true.parquet")
    assert catalogs[2] == catalogs[0]
    outs = [line[line.index("--out") + 1] for line in runs]
    assert tables[:8] == ["tables", outs[0], "--true", outs[1], "--dsm", outs[2], "--literal", outs[3]]
    assert figures[:2] == ["figures", outs[0]]
    assert tables[-2:] == figures[-2:]


@pytest.mark.parametrize(("root", "folder"), [("/data/gerod", "/data/gerod"), ("GeRoD.zip", "GeRoD")])
def test_reproduce_with_gerod_root_uses_real_tiles(tmp_path, root, folder):
    catalog, _, run, dsm, literal, _, _, tables, _ = commands(tmp_path, f"GEROD_ROOT={root}")
    assert catalog == ["catalog", "gerod", root, "-o", "runs/gerod/survey/catalog.parquet"]
    assert "ablation" in run
    assert {line[line.index("--allow") + 1] for line in (run, dsm, literal)} == {folder}
    assert {line[line.index("--catalog") + 1] for line in (run, dsm, literal)} == {catalog[-1]}
    assert tables[tables.index("--dsm") + 1] == dsm[dsm.index("--out") + 1]
    assert "--true" not in tables


@pytest.mark.parametrize("words", [["SEED=5"], ["SEED=5", "GEROD_ROOT=/data/gerod"]])
def test_reproduce_synthetic_scenes_run_with_both_references(tmp_path, words):
    _, scenes, *_, circular, true, tables, _ = commands(tmp_path, *words)
    assert scenes[:4] == ["catalog", "synthetic", "--preset", "dsc3d"]
    assert scenes[-2:] == ["--seed", "5"]
    folder = Path(scenes[scenes.index("-o") + 1])
    for run, name, option in (
        (circular, "catalog.parquet", "--dsc3d"),
        (true, "catalog_true.parquet", "--dsc3d-true"),
    ):
        assert run[run.index("--config") + 1] == "dsc3d"
        assert run[run.index("--catalog") + 1] == str(folder / name)
        assert tables[tables.index(option) + 1] == run[run.index("--out") + 1]
