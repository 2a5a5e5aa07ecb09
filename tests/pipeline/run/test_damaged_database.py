"""Commands on a damaged run database: they give the figures of the undamaged one, from the tiles' markers."""

import json
import os
import random
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from flexroad.catalog import Catalog
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.cleanup import find_garbage
from flexroad.pipeline.run.lock import Owner
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import _failures, _rows, plan_run, run_tiles
from flexroad.pipeline.run.status import open_database, progress, recorded, summary
from flexroad.pipeline.store.database import NAME
from flexroad.pipeline.store.tables import read_metrics
from tests.builders import finish_run

PAGE = 4096
"""Size of a page of the disk (bytes)."""
DAMAGES = 2000


@pytest.fixture(scope="module")
def made(made_survey, tmp_path_factory) -> Path:
    """The folder of a run, run twice: two cached tiles, one computed by the second run, one failed."""
    folder = tmp_path_factory.mktemp("damaged")
    survey = shutil.copytree(made_survey, folder / "survey")
    tiles = Catalog.read(survey / "catalog.parquet").tiles
    dsm = [tile.paths(tile.layer("dsm"))[0] for tile in tiles]
    dsm[3].write_bytes(dsm[3].read_bytes()[:1000])
    run = finish_run(folder / "run", survey)
    os.utime(dsm[2], (1, 1))
    counts = run_tiles(run, SerialExecutor())
    assert (counts.done, counts.cached, counts.failed) == (3, 2, 1)
    return run.path


@pytest.fixture
def run(made, tmp_path) -> Run:
    """A copy of that run, for tests to damage."""
    return Run.open(shutil.copytree(made, tmp_path / "run"))


def outcome_of_readers(run: Run) -> dict:
    """What `status`, the map and `clean` find."""
    last = json.loads((run.path / "summary.json").read_bytes())
    holder = replace(Owner.me(), since=last["start"])
    with open_database(run) as database:
        states = list(recorded(run, database))
    live, _ = progress(run, holder)
    found = {"status": summary(run), "live": replace(live, seconds=0), "states": states}
    return found | {"garbage": list(find_garbage([run]))}


def outcome(run: Run) -> dict:
    """What commands find, and the plan and the tables of another run; changes the database alone."""
    found = outcome_of_readers(run)
    with open_database(run, write=True) as database:
        plan = plan_run(run, database, lambda tile: True, frozenset(), lambda result: None, False)
        found["plan"] = (list(plan.todo), plan.new, plan.changed, plan.vanished)
        found["rows"], found["failures"] = list(_rows(database)), list(_failures(database))
    return found


def damage_figures(path: Path) -> None:
    """Change a digit in all copies of a figure, and the state of a tile."""
    data = path.read_bytes().replace(b'"l2_road_m": 0', b'"l2_road_m": 8')
    path.write_bytes(data.replace(b'"cached"', b'"failed"', 1))


def damage_json(path: Path) -> None:
    path.write_bytes(path.read_bytes().replace(b"{", b""))


def damage_all(path: Path) -> None:
    path.write_bytes(bytes(range(256)) * 64)


EACH = pytest.mark.parametrize("damage", [damage_figures, damage_json, damage_all])


@EACH
def test_commands_on_damaged_database_say_and_write_the_same(damage, run, flexroad, tmp_path):
    files = [tmp_path / "map.geojson", *(run.path / name for name in ("metrics.parquet", "failures.csv"))]
    commands = [
        ("status", run.path, "--geojson", files[0]),
        ("status", run.path, "--json"),
        ("clean", run.path, "--dry-run"),
        ("report", run.path, "--format", "md"),
    ]
    expected = [flexroad(*words) for words in commands]
    report, before = (run.path / "report.md").read_text(), [path.read_bytes() for path in files]
    for words, said in zip(commands, expected, strict=True):
        damage(run.path / NAME)
        assert flexroad(*words) == said
    assert (run.path / "report.md").read_text() == report
    damage(run.path / NAME)
    for path in files[1:]:
        path.unlink()
    said = flexroad("rerun", run.path, "--executor", "serial").expected(1)
    assert "4 tiles: 3 done (3 cached), 1 failed, 0 pending; 0 new, 0 changed, 0 vanished" in said.out
    assert [path.read_bytes() for path in files] == before
    assert summary(run).cached == 3


def test_database_damaged_during_run_is_repaired(run):
    rows = read_metrics(run.path)

    def damage(_):
        damage_all(run.path / NAME)

    counts = run_tiles(run, SerialExecutor(), watch=damage)
    assert (counts.done, counts.cached, counts.failed) == (3, 3, 1)
    pd.testing.assert_frame_equal(read_metrics(run.path), rows)
    with open_database(run) as database:
        assert database.lists(tile.id for tile in run.catalog.tiles)


def test_verify_takes_tables_from_markers(run):
    """An entry that is wrong, but has a valid checksum and names the marker that is there."""
    rows = read_metrics(run.path)
    first = run.catalog.tiles[0].id
    with open_database(run, write=True) as database:
        record = database.get(first)
        database.record(replace(record, rows=tuple(row | {"l2_road_m": 8.0} for row in record.rows)))
    run_tiles(run, SerialExecutor())
    assert (read_metrics(run.path).l2_road_m == 8).sum() == len(record.rows)
    run_tiles(run, SerialExecutor(), verify=True)
    pd.testing.assert_frame_equal(read_metrics(run.path), rows)


def test_status_of_damaged_database_does_not_write(run):
    for damage in (damage_figures, damage_json, damage_all):
        damage(run.path / NAME)
        before = {path: path.stat().st_mtime_ns for path in run.path.rglob("*")}
        outcome_of_readers(run)
        assert {path: path.stat().st_mtime_ns for path in run.path.rglob("*")} == before


def flip_bits(data: bytearray, rng: random.Random) -> bytes:
    for _ in range(rng.choice((1, 1, 1, 2, 8, 64))):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return data


def cut_off(data: bytearray, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data))]


def overwrite(data: bytearray, rng: random.Random) -> bytes:
    length, start = rng.choice((1, 16, 512, PAGE)), rng.randrange(len(data))
    end = min(start + length, len(data))
    data[start:end] = rng.choice((bytes(end - start), b"\xff" * (end - start), rng.randbytes(end - start)))
    return data


def drop_bytes(data: bytearray, rng: random.Random) -> bytes:
    start = rng.randrange(len(data))
    del data[start : start + rng.choice((1, 1, 7, 100, PAGE))]
    return data


def swap_pages(data: bytearray, rng: random.Random) -> bytes:
    one, two = (slice(PAGE * i, PAGE * i + PAGE) for i in rng.sample(range(len(data) // PAGE), 2))
    # Half of the time one page is lost, as by a write to a wrong place.
    data[one], data[two] = data[two], rng.choice((data[one], data[two]))
    return data


def append_bytes(data: bytearray, rng: random.Random) -> bytes:
    return data + rng.randbytes(rng.choice((1, 100, PAGE)))


def flip_text(data: bytearray, rng: random.Random) -> bytes:
    """Change a digit of a figure: the records stay valid JSON."""
    digits = [i for i, byte in enumerate(data) if 0x30 <= byte <= 0x39]
    data[rng.choice(digits)] = rng.choice(b"0123456789")
    return data


KINDS: list[Callable[[bytearray, random.Random], bytes]] = [
    flip_bits, cut_off, overwrite, drop_bytes, swap_pages, append_bytes, flip_text,
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.soak("runs")
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_any_damage_of_database_changes_no_figure(kind, run):
    path = run.path / NAME
    whole = path.read_bytes()
    expected = outcome(run)
    assert expected["plan"] == ([3], 0, 0, 0)
    assert [state for _, state, _ in expected["states"]] == ["cached", "cached", "done", "failed"]
    # The plan of a run turns done tiles into cached ones, so the file is the first one again each time.
    rng = random.Random(kind.__name__)
    for number in range(-(-DAMAGES // len(KINDS))):
        path.write_bytes(kind(bytearray(whole), rng))
        assert outcome(run) == expected, f"damage {number}"
