"""`flexroad clean`: all that nobody needs goes, nothing else does; the truth is a run made from nothing."""

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
from flexroad.pipeline.run.garbage import delete, exclusive, find_garbage
from flexroad.pipeline.run.lock import run_lock
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.run.store_users import runs_using, unregister

QUICK = {
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
    """Three tiles, of which one fails: its DTM is not there."""
    one, two, three, _ = Catalog.read(made_survey / "catalog.parquet").tiles
    broken = tuple(
        replace(layer, files=("gone.tif",)) if layer.name == "dtm" else layer for layer in three.layers
    )
    return Catalog((one, two, replace(three, layers=broken)))


@pytest.fixture(scope="module")
def made(catalog, tmp_path_factory):
    """Make a run of options and tiles in a folder; what was made once is copied."""
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


def cleaned(run: Run, without=()) -> dict[str, set[str]]:
    """Drop the waste; return the files dropped by kind, relative to the run's folder's parent."""
    dropped: dict[str, set[str]] = {}
    with run_lock(run.path), exclusive(run, without, print) as runs:
        for one in delete(find_garbage(runs)):
            dropped.setdefault(one.kind, set()).add(str(one.path.relative_to(run.path.parent)))
    return dropped


def test_what_is_left_is_what_a_new_run_makes(made, tmp_path):
    """The configuration was another, with another export; then a tile vanished."""
    run = made(tmp_path / "run", (QUICK, 3), (LATER, 3), (LATER, 2))
    fresh = made(tmp_path / "fresh", (LATER, 2))
    before = files(run.path)
    dropped = cleaned(run)
    for part in ("store", "tiles"):
        assert files(run.path / part) == files(fresh.path / part)
    assert before - files(run.path) == {
        name.removeprefix("run/") for names in dropped.values() for name in names
    }
    # Folders, too.
    assert {path.name for path in (run.path / "tiles").iterdir()} == {
        path.name for path in (fresh.path / "tiles").iterdir()
    }
    assert dropped.keys() == {"artefacts", "products", "tiles"}
    assert {Path(name).suffix for name in dropped["products"]} == {".glb", ".tif"}
    how = run_tiles(run, SerialExecutor())
    assert (how.cached, how.done) == (2, 2)


def test_after_it_no_stage_is_computed_that_was_not_before(made, tmp_path):
    computed = []
    for name in ("cleaned", "not"):
        run = made(tmp_path / name, (QUICK, 3), (LATER, 3))
        if name == "cleaned":
            assert cleaned(run)
        # The artefacts of a tile that lost its marker serve it still.
        for marker in (run.path / "tiles").glob("*/item.json"):
            marker.unlink()
        results = []
        run_tiles(run, SerialExecutor(), watch=results.append)
        computed.append([result.computed for result in results])
    assert computed[0] == computed[1]
    assert not any("evaluate" in stages for stages in computed[0])


def test_foreign_files_stay_and_those_of_killed_writers_go(made, tmp_path):
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
    dropped = cleaned(run)
    assert all(path.exists() for path in foreign)
    assert not any(path.exists() for path in killed)
    assert len(dropped["temporary files"]) == len(killed)


def test_finding_drops_nothing(made, tmp_path):
    run = made(tmp_path / "run", (QUICK, 3), (LATER, 2))
    before = listing(run.path)
    with exclusive(run, (), print) as runs:
        assert sum(1 for _ in find_garbage(runs)) > 5
    assert listing(run.path) == before


def test_what_another_run_of_the_store_needs_stays(made, tmp_path):
    store, one, two = tmp_path / "store", tmp_path / "one", tmp_path / "two"
    first = made.into(one, QUICK, 2, store)
    kept = files(store / "fit")
    second = made.into(two, LATER, 2, store)
    assert set(runs_using(store)) == {one, two}
    assert not cleaned(first)
    assert not cleaned(second)
    # Its tiles are gone from one of them.
    shutil.rmtree(two)
    with pytest.raises(ConfigError, match=rf"{two} uses the store .* not there.*--forget {two}"):
        cleaned(first)
    assert cleaned(first, [two]).keys() == {"artefacts"}
    assert files(store / "fit") == kept
    assert unregister(store, two)
    assert not cleaned(first)


def test_a_run_that_cannot_be_read_or_is_at_work_stops_it(made, tmp_path):
    store, one, two = tmp_path / "store", tmp_path / "one", tmp_path / "two"
    run = made.into(one, QUICK, 1, store)
    made.into(two, QUICK, 1, store)
    with run_lock(two), pytest.raises(ConfigError, match=f"{two} is in use by pid"):
        cleaned(run)
    (two / "config.yaml").write_text("fit: {iterations: many}")
    before = files(store)
    with pytest.raises(ConfigError, match=f"{two} uses the store .* cannot be read"):
        cleaned(run)
    (store / "runs" / "damaged.json").write_text("{")
    with pytest.raises(ConfigError, match="the list of runs"):
        cleaned(run)
    assert files(store) - {"runs/damaged.json"} == before


def test_a_store_in_another_runs_folder_is_that_runs_too(made, tmp_path):
    owner = made(tmp_path / "one", (QUICK, 2))
    guest = made.into(tmp_path / "two", LATER, 1, owner.path / "store")
    dropped = cleaned(guest)
    assert not dropped
    assert not cleaned(owner)
