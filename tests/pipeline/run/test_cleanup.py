"""`flexroad clean` deletes all files that are not needed, and no others; compared with a new run."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from flexroad.catalog import Catalog
from flexroad.catalog.storage.paths import listing
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run import cleanup
from flexroad.pipeline.run.cleanup import delete, exclusive, find_garbage
from flexroad.pipeline.run.lock import run_lock
from flexroad.pipeline.run.record import Run, runs_using, unregister
from flexroad.pipeline.run.runner import run_tiles
from tests.builders import LIGHT

NOW = LIGHT | {"export": {"variants": ["rgt", "flexroad"], "formats": ["glb", "cog"]}}
LATER = LIGHT | {
    "fit": LIGHT["fit"] | {"iterations": 4},
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


def make(path: Path, catalog: Catalog, options: dict, tiles: int, store: Path | None = None) -> Run:
    run = Run.create(path, compose(options, "c"), Catalog(catalog.tiles[:tiles]), store)
    run_tiles(run, SerialExecutor())
    return run


@pytest.fixture(scope="module")
def made(catalog, tmp_path_factory):
    """Return a run after some steps, each with its options and number of tiles; equal runs are copied."""
    cache: dict[str, Path] = {}

    def copied(path: Path, *steps: tuple[dict, int]) -> Run:
        key = str(steps)
        if key not in cache:
            cache[key] = tmp_path_factory.mktemp("made") / "run"
            for options, tiles in steps:
                make(cache[key], catalog, options, tiles)
        shutil.copytree(cache[key], path)
        return Run.open(path)

    return copied


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
    run = made(tmp_path / "run", (NOW, 3), (LATER, 3), (LATER, 2))
    fresh = made(tmp_path / "fresh", (LATER, 2))
    before = files(run.path)
    with exclusive(run, (), print) as runs:
        assert sum(1 for _ in find_garbage(runs)) > 5
    assert files(run.path) == before
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


def test_clean_keeps_foreign_files_and_deletes_temporary_files(made, tmp_path):
    run = made(tmp_path / "run", (NOW, 3), (LATER, 3), (LATER, 2))
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
    run = made(tmp_path / "run", (NOW, 1), (LATER, 1))
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


def test_clean_keeps_artefacts_of_other_runs_of_the_store(catalog, tmp_path):
    store, one, two = tmp_path / "store", tmp_path / "one", tmp_path / "two"
    first = make(one, catalog, NOW, 2, store)
    kept = files(store / "fit")
    second = make(two, catalog, LATER, 2, store)
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


def test_clean_with_other_run_active_or_unreadable_raises(catalog, tmp_path):
    store, one, two = tmp_path / "store", tmp_path / "one", tmp_path / "two"
    run = make(one, catalog, NOW, 1, store)
    make(two, catalog, NOW, 1, store)
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


def test_clean_keeps_artefacts_of_run_that_contains_the_store(made, catalog, tmp_path):
    owner = made(tmp_path / "one", (NOW, 2))
    guest = make(tmp_path / "two", catalog, LATER, 1, owner.path / "store")
    assert not clean(guest)
    assert not clean(owner)
