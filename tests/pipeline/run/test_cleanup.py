"""`flexroad clean` deletes all files that are not needed, and no others; compared with a new run."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from flexroad.catalog import Catalog
from flexroad.catalog.storage.paths import listing
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run import cleanup
from flexroad.pipeline.run.cleanup import delete, exclusive, find_garbage
from flexroad.pipeline.run.lock import run_lock
from flexroad.pipeline.run.record import Run, runs_using, unregister
from flexroad.pipeline.run.runner import run_tiles

QUICK = {
    "extends": "defaults",
    "fit": {"method": "nurbs", "control_points": [8, 8], "iterations": 3},
    "variants": {"rgt": {"fit": "raster", "sample": "uniform"}, "flexroad": {}},
    "export": {"variants": ["rgt", "flexroad"], "formats": ["glb", "cog"]},
}
LATER = QUICK | {
    "fit": {"method": "nurbs", "control_points": [8, 8], "iterations": 4},
    "export": {"variants": ["flexroad"], "formats": ["glb", "npz"]},
}


@pytest.fixture(scope="module")
def catalog(made_survey) -> Catalog:
    """A catalog of three tiles; the third fails because its DTM is missing."""
    one, two, three, _ = Catalog.read(made_survey / "catalog.parquet").tiles
    broken = tuple(
        replace(layer, files=("gone.tif",), extents=()) if layer.name == "dtm" else layer
        for layer in three.layers
    )
    return Catalog((one, two, replace(three, layers=broken)))


@pytest.fixture(scope="module")
def made(catalog, tmp_path_factory):
    """Factory of finished runs with given options and number of tiles; equal runs are copied."""
    cache: dict[str, Path] = {}

    def make(path: Path, options: dict, tiles: int, store: Path | None = None) -> Run:
        config = tmp_path_factory.mktemp("config") / "c.yaml"
        config.write_text(yaml.safe_dump(options, sort_keys=False))
        run = Run.create(path, load_config(config), Catalog(catalog.tiles[:tiles]), store)
        run_tiles(run, SerialExecutor())
        return run

    def make_or_copy(path: Path, *steps: tuple[dict, int]) -> Run:
        key = str(steps)
        if key not in cache:
            cache[key] = tmp_path_factory.mktemp("made") / "run"
            for options, tiles in steps:
                make(cache[key], options, tiles)
        shutil.copytree(cache[key], path)
        return Run.open(path)

    make_or_copy.into = make
    return make_or_copy


def files(folder: Path) -> set[str]:
    return set(listing(folder))


def clean(run: Run, without=()) -> dict[str, set[str]]:
    """Delete the garbage; return the deleted files by kind, relative to the parent of the run's folder."""
    deleted: dict[str, set[str]] = {}
    with run_lock(run.path), exclusive(run, without, print) as runs:
        for file in delete(find_garbage(runs)):
            deleted.setdefault(file.kind, set()).add(str(file.path.relative_to(run.path.parent)))
    return deleted


def test_clean_leaves_files_of_a_new_run(made, tmp_path):
    """After a change of options and export, and after a tile left the catalog."""
    run = made(tmp_path / "run", (QUICK, 3), (LATER, 3), (LATER, 2))
    fresh = made(tmp_path / "fresh", (LATER, 2))
    before = files(run.path)
    deleted = clean(run)
    for part in ("store", "tiles"):
        assert files(run.path / part) == files(fresh.path / part)
    assert before - files(run.path) == {
        name.removeprefix("run/") for names in deleted.values() for name in names
    }
    # Empty folders are deleted, too.
    assert {path.name for path in (run.path / "tiles").iterdir()} == {
        path.name for path in (fresh.path / "tiles").iterdir()
    }
    assert deleted.keys() == {"artefacts", "products", "tiles"}
    assert {Path(name).suffix for name in deleted["products"]} == {".glb", ".tif"}
    summary = run_tiles(run, SerialExecutor())
    assert (summary.cached, summary.done) == (2, 2)


def test_run_after_clean_computes_no_additional_stage(made, tmp_path):
    computed = []
    for name in ("cleaned", "not"):
        run = made(tmp_path / name, (QUICK, 3), (LATER, 3))
        if name == "cleaned":
            assert clean(run)
        # Tiles without a marker are processed again, from the remaining artefacts.
        for marker in (run.path / "tiles").glob("*/item.json"):
            marker.unlink()
        results = []
        run_tiles(run, SerialExecutor(), watch=results.append)
        computed.append([result.computed for result in results])
    assert computed[0] == computed[1]
    assert not any("evaluate" in stages for stages in computed[0])


def test_clean_keeps_foreign_files_and_deletes_temporary_files(made, tmp_path):
    run = made(tmp_path / "run", (QUICK, 3), (LATER, 3), (LATER, 2))
    gone = next(
        path for path in (run.path / "tiles").iterdir() if path.name not in {t.id for t in run.catalog.tiles}
    )
    stage = next((run.path / "store" / "fit").iterdir())
    old = next(stage.glob("*.npz")).name
    foreign = [
        gone / "notes.txt",
        gone / f"{gone.name}_mine.glb",
        gone / "sub" / "item.json",
        run.path / "tiles" / "readme.txt",
        run.path / "store" / "fit" / old,
        stage / "0123.npz",
        stage / f"{'f' * 31}G.npz",
        run.path / "store" / "mine" / stage.name / old,
        run.path / ".hidden.tmp",
        run.path / "report.html",
    ]
    killed = [
        folder / f".{name}.{'0a' * 16}.tmp"
        for folder, name in ((run.path, "metrics.parquet"), (stage, old), (gone, "item.json"))
    ]
    killed += [folder / f".probe-{'0a' * 16}" for folder in (run.path, run.store)]
    for path in (*foreign, *killed):
        path.parent.mkdir(exist_ok=True, parents=True)
        path.write_text("x")
    deleted = clean(run)
    assert all(path.exists() for path in foreign)
    assert not any(path.exists() for path in killed)
    assert len(deleted["temporary files"]) == len(killed)


def test_clean_keeps_what_is_written_to_the_store_meanwhile(made, tmp_path, monkeypatch):
    run = made(tmp_path / "run", (QUICK, 1), (LATER, 1))
    unneeded = clean(run)["artefacts"]
    name = f"{'ab' * 16}"
    old, new = (tmp_path / "run" / "store" / "fit" / name[:2] / f"{name[:-1]}{end}.npz" for end in "01")
    temporaries = [path.with_name(f".{path.name}.{'0' * 32}.tmp") for path in (old, new)]
    needed = cleanup._needed

    def written(runs):
        for path in (new, temporaries[1]):
            path.write_bytes(b"")
        return needed(runs)

    old.parent.mkdir(exist_ok=True)
    for path in (old, temporaries[0]):
        path.write_bytes(b"")
    monkeypatch.setattr(cleanup, "_needed", written)
    assert clean(run) == {
        "artefacts": {str(old.relative_to(tmp_path))},
        "temporary files": {str(temporaries[0].relative_to(tmp_path))},
    }
    assert unneeded
    assert new.exists()
    assert temporaries[1].exists()
    monkeypatch.undo()
    assert new.name in {Path(path).name for path in clean(run)["artefacts"]}


def test_find_garbage_deletes_nothing(made, tmp_path):
    run = made(tmp_path / "run", (QUICK, 3), (LATER, 2))
    before = listing(run.path)
    with exclusive(run, (), print) as runs:
        assert sum(1 for _ in find_garbage(runs)) > 5
    assert listing(run.path) == before


def test_clean_keeps_artefacts_of_other_runs_of_the_store(made, tmp_path):
    store, one, two = tmp_path / "store", tmp_path / "one", tmp_path / "two"
    first = made.into(one, QUICK, 2, store)
    kept = files(store / "fit")
    second = made.into(two, LATER, 2, store)
    assert set(runs_using(store)) == {one, two}
    assert not clean(first)
    assert not clean(second)
    # One of the two runs is deleted.
    shutil.rmtree(two)
    with pytest.raises(ConfigError, match=rf"{two} uses the store .* missing.*--forget {two}"):
        clean(first)
    assert clean(first, [two]).keys() == {"artefacts"}
    assert files(store / "fit") == kept
    unregister(store, two)
    assert not clean(first)


def test_clean_with_other_run_active_or_unreadable_raises(made, tmp_path):
    store, one, two = tmp_path / "store", tmp_path / "one", tmp_path / "two"
    run = made.into(one, QUICK, 1, store)
    made.into(two, QUICK, 1, store)
    with run_lock(two), pytest.raises(ConfigError, match=f"{two} is in use by pid"):
        clean(run)
    (two / "config.yaml").write_text("fit: {iterations: many}")
    before = files(store)
    with pytest.raises(ConfigError, match=f"{two} uses the store .* cannot be read"):
        clean(run)
    (store / "runs" / "damaged.json").write_text("{")
    with pytest.raises(ConfigError, match="the list of runs"):
        clean(run)
    assert files(store) - {"runs/damaged.json"} == before


def test_clean_keeps_artefacts_of_run_that_contains_the_store(made, tmp_path):
    owner = made(tmp_path / "one", (QUICK, 2))
    guest = made.into(tmp_path / "two", LATER, 1, owner.path / "store")
    deleted = clean(guest)
    assert not deleted
    assert not clean(owner)
