"""Power failures at any point of a run: the next run gives the results of an undisturbed one.

By default a sample of the possible states is tried; ``FLEXROAD_ALL_FAULTS=1`` tries 200.
"""

import contextlib
import json
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random

import pytest
import yaml

from flexroad.tools.synthetic.scenes import write_scenes
from tests import command_line
from tests.builders import LIGHT
from tests.faulty_files import Operation, intercepted
from tests.power_loss import Disk, Recording, write_state
from tests.whole_run import assert_whole, item_times, temporary_files

pytestmark = [pytest.mark.slow, pytest.mark.soak("runs")]

STATES = 200 if os.environ.get("FLEXROAD_ALL_FAULTS") else 10
"""Possible states that are tried, of each of the two recorded runs."""
ONE = LIGHT | {"export": {"formats": ["ply"]}}
OTHER = ONE | {"fit": LIGHT["fit"] | {"iterations": 4}}
"""Other options: the products have other contents of the same size."""
NOT_FLUSHED = ("store", "log.jsonl", "tiles.geojson")
"""Parts of a run that can be made again, and its log."""
DAY_S = 86400


@dataclass(frozen=True)
class Recorded:
    """A recorded run; its command lines now and before, each with the undisturbed run that it gives."""

    recording: Recording
    out: Path
    now: tuple[list, Path]
    before: tuple[list, Path]


@pytest.fixture(scope="module")
def command(tmp_path_factory) -> Callable[[str], list]:
    """Run commands of two adjacent tiles, without the run folder, by the name of their options."""
    folder = tmp_path_factory.mktemp("small")
    write_scenes(folder, 2, seed=3, size_m=60)
    for name, options in {"one": ONE, "other": OTHER}.items():
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(options, sort_keys=False))

    def words(name: str) -> list:
        catalog = folder / "catalog.parquet"
        files = ["--config", folder / f"{name}.yaml", "--catalog", catalog]
        return ["run", *files, "--executor", "serial", "--out"]

    return words


@pytest.fixture(scope="module", params=["first run", "run with other options"])
def recorded(request, command, tmp_path_factory) -> Recorded:
    """The only run of a folder, or one after another with other options."""
    undisturbed = {}
    for name in ("one", "other"):
        undisturbed[name] = tmp_path_factory.mktemp(name) / "run"
        command_line.call(*command(name), undisturbed[name]).expected(0)
    root = tmp_path_factory.mktemp("recorded")
    names = ("one",) if request.param == "first run" else ("one", "other")
    for name in names:
        recording = Recording(root)
        with intercepted(root, recording):
            command_line.call(*command(name), root / "run").expected(0)
    now, before = names[-1], names[0]
    return Recorded(
        recording, root / "run", (command(now), undisturbed[now]), (command(before), undisturbed[before])
    )


@pytest.fixture(autouse=True)
def no_waiting(monkeypatch):
    """Nobody waits for the lock of an unknown process."""
    monkeypatch.setattr(time, "sleep", lambda seconds: None)


def restart(out: Path) -> None:
    """Let a day pass since the files were written, and let the machine start again."""
    lock = out / "lock.json"
    if not lock.exists():
        return
    # Its content may be lost.
    with contextlib.suppress(ValueError):
        lock.write_text(json.dumps(json.loads(lock.read_bytes()) | {"boot": "before"}))
    os.utime(lock, times=(time.time() - DAY_S,) * 2)


def done(operations: list[Operation], out: Path) -> set[Path]:
    """Markers of tiles that count as done: after the marker something else was written."""
    markers, finished = set(), set()
    for operation in operations:
        if operation.kind != "fsync":
            finished |= markers
        if operation.kind == "rename" and operation.target.name == "item.json":
            markers.add(operation.target)
        if operation.kind == "remove" and operation.path.name == "item.json":
            markers.discard(operation.path)
            finished.discard(operation.path)
    return {path.relative_to(out) for path in finished}


def test_power_failure_next_run_is_whole(recorded, tmp_path):
    operations, wrong = recorded.recording.operations, []
    for seed in range(STATES):
        random = Random(seed)
        end = random.randint(1, len(operations))
        out = tmp_path / str(seed) / "run"
        state = Disk(recorded.recording, end).after_failure(random)
        write_state(state, recorded.recording.root, out.parent)
        words, undisturbed = random.choice((recorded.now, recorded.before))
        restart(out)
        kept = item_times(out)
        try:
            with intercepted(out, lambda operation: None):
                command_line.call(*words, out).expected(0)
            if temporary_files(out):
                command_line.call("clean", out).expected(0)
            assert_whole(out, undisturbed)
            if words == recorded.now[0]:
                after = item_times(out)
                for name in done(operations[:end], recorded.out):
                    assert out / name in kept, f"{name} is lost"
                    assert after[out / name] == kept[out / name], f"{name} was written again"
        except AssertionError as error:
            first = " ".join(str(error).split())
            last = operations[end - 1]
            wrong.append(f"{seed} after {end} ({last.kind} {last.path.name}) {first[:400]}")
        shutil.rmtree(out.parent)
    print(f"{STATES} states of {len(operations)} operations, {len(wrong)} wrong")  # noqa: T201
    assert not wrong, "\n".join(wrong)


def test_power_failure_after_the_end_changes_nothing(recorded, tmp_path):
    """What a run has reported is on the disk."""
    recording = recorded.recording
    state = Disk(recording, len(recording.operations)).after_failure(Random(0), least=True)
    write_state(state, recording.root, tmp_path)
    after = {path.relative_to(tmp_path / "run"): path for path in (tmp_path / "run").rglob("*")}
    for path in recorded.out.rglob("*"):
        name = path.relative_to(recorded.out)
        if path.is_file() and name.parts[0] not in NOT_FLUSHED:
            assert name in after, name
            assert after[name].read_bytes() == path.read_bytes(), name
