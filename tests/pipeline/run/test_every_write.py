"""Faults and power failures at any operation on a file: the next run equals an undisturbed one.

By default a sample is tried; ``FLEXROAD_ALL_FAULTS=1`` tries every operation and 200 states after a power
failure, which takes about ten minutes (``pytest -s`` then prints the numbers).
"""

import contextlib
import json
import os
import shutil
import signal
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random

import pytest
import yaml

from flexroad.pipeline.run.lock import Owner
from flexroad.tools.synthetic.scenes import write_scenes
from tests import command_line
from tests.builders import LIGHT
from tests.faulty_files import FAULTS, Faulty, Operation, intercepted
from tests.power_loss import Disk, Recording, write_state
from tests.whole_run import assert_whole, item_times, temporary_files

pytestmark = [pytest.mark.slow, pytest.mark.soak("runs")]

EVERY = bool(os.environ.get("FLEXROAD_ALL_FAULTS"))
SAMPLE = 12
"""Operations that have a fault, of each kind of fault."""
STATES = 200 if EVERY else 10
"""Possible states that are tried, of each of the two recorded runs."""
ONE = LIGHT | {"export": {"formats": ["ply"]}}
OTHER = ONE | {"fit": LIGHT["fit"] | {"iterations": 4}}
"""Other options: the products have other contents of the same size."""
NOT_FLUSHED = ("store", "log.jsonl", "tiles.geojson")
"""Parts of a run that can be made again, and its log."""
DAY_S = 86400


@pytest.fixture(scope="module")
def command(tmp_path_factory) -> Callable[[dict], list]:
    """Return the words of a run of two adjacent tiles with some options, without the run folder."""
    folder = tmp_path_factory.mktemp("small")
    catalog = write_scenes(folder, 2, seed=3, size_m=60)

    def words(options: dict) -> list:
        config = folder / f"{hash(str(options))}.yaml"
        config.write_text(yaml.safe_dump(options, sort_keys=False))
        return ["run", "--config", config, "--catalog", catalog, "--executor", "serial", "--out"]

    return words


def repair(words: list, out: Path, undisturbed: Path) -> None:
    """Run again, without any fault: the run is complete, and without temporary files after `clean`."""
    with intercepted(out, lambda operation: None):
        command_line.call(*words, out).expected(0)
    if temporary_files(out):
        command_line.call("clean", out).expected(0)
    assert_whole(out, undisturbed)


def told(error: AssertionError) -> str:
    return " ".join(str(error).split())[:400] or repr(error)


# --- faults at an operation ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def undisturbed(command, tmp_path_factory) -> tuple[Path, list[Operation]]:
    """A finished run without faults, and its operations."""
    out, counting = tmp_path_factory.mktemp("undisturbed") / "run", Faulty(-1, lambda: None)
    command_line.call(*command(LIGHT), tmp_path_factory.mktemp("first") / "run").expected(0)
    with intercepted(out, counting):
        command_line.call(*command(LIGHT), out).expected(0)
    return out, counting.met


def run_with(fault: Faulty, words: list, out: Path) -> command_line.Said:
    with intercepted(out, fault):
        return command_line.call(*words, out)


def killed_with(fault: Faulty, words: list, out: Path) -> int:
    """Run in a copy of this process, which ends itself; return its exit code."""
    return command_line.forked(lambda: run_with(fault, words, out).code)


def check_after_error(said: command_line.Said, out: Path, fault: Faulty) -> None:
    """One line tells the error; no temporary file is left, except one whose removal failed."""
    if said.code == 0:
        # The fault met nothing that the results need.
        assert not said.errors
        assert json.loads((out / "summary.json").read_text())["done"] == 2
    else:
        assert said.code in (1, 2)
        assert said.errors
        assert all(str(out) in line for line in said.errors), said.errors
    kept = {operation.path for operation in fault.failed if operation.kind == "remove"}
    assert set(temporary_files(out)) <= kept


def runs_in_log(out: Path) -> int:
    """Number of runs whose start is in the log; other lines may be cut off."""
    log = out / "log.jsonl"
    lines = log.read_text().splitlines() if log.exists() else []
    return sum(line.startswith("{") and line.endswith("}") and '"event": "run"' in line for line in lines)


@pytest.mark.parametrize("kind", FAULTS)
def test_run_fault_at_any_write_next_run_is_whole(kind, command, undisturbed, tmp_path):
    (whole, operations), words = undisturbed, command(LIGHT)
    wrong, codes, last = [], Counter[int](), len(operations) - 1
    sample = {round(i * last / (SAMPLE - 1)) for i in range(SAMPLE)}
    for at in range(last + 1) if EVERY else sorted(sample):
        out, fault = tmp_path / str(at) / "run", FAULTS[kind](at)
        try:
            if kind == "killed":
                assert killed_with(fault, words, out) == -signal.SIGKILL
                assert len(temporary_files(out)) <= 1
            else:
                said = run_with(fault, words, out)
                codes[said.code] += 1
                check_after_error(said, out, fault)
            if (out / "lock.json").exists():
                # The process that could not remove its lock would have ended by then.
                (out / "lock.json").write_bytes(replace(Owner.me(), pid=2**22 + 1).data)
            finished, logged = item_times(out), runs_in_log(out)
            repair(words, out, whole)
            assert finished.items() <= item_times(out).items()
            assert runs_in_log(out) == logged + 1
        except AssertionError as error:
            wrong.append(f"{at} {operations[at].kind} {operations[at].path.name}: {told(error)}")
    print(f"{kind}: of {len(operations)} operations, exit codes {dict(codes)}")  # noqa: T201
    assert not wrong, "\n".join(wrong)


# --- power failures -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Recorded:
    """A recorded run; its options now and before, and the undisturbed runs that these give."""

    recording: Recording
    out: Path
    now: str
    before: str
    undisturbed: dict[str, Path]


OPTIONS = {"one": ONE, "other": OTHER}


@pytest.fixture(scope="module", params=["first run", "run with other options"])
def recorded(request, command, tmp_path_factory) -> Recorded:
    """The only run of a folder, or one after another with other options."""
    undisturbed = {}
    for name, options in OPTIONS.items():
        undisturbed[name] = tmp_path_factory.mktemp(name) / "run"
        command_line.call(*command(options), undisturbed[name]).expected(0)
    root = tmp_path_factory.mktemp("recorded")
    names = ("one",) if request.param == "first run" else ("one", "other")
    for name in names:
        recording = Recording(root)
        with intercepted(root, recording):
            command_line.call(*command(OPTIONS[name]), root / "run").expected(0)
    return Recorded(recording, root / "run", names[-1], names[0], undisturbed)


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


def test_power_failure_next_run_is_whole(recorded, command, tmp_path, monkeypatch):
    # Nobody waits for the lock of an unknown process.
    monkeypatch.setattr(time, "sleep", lambda seconds: None)
    operations, wrong = recorded.recording.operations, []
    for seed in range(STATES):
        random = Random(seed)
        end = random.randint(1, len(operations))
        out = tmp_path / str(seed) / "run"
        write_state(Disk(recorded.recording, end).after_failure(random), recorded.recording.root, out.parent)
        name = random.choice((recorded.now, recorded.before))
        restart(out)
        kept = item_times(out)
        try:
            repair(command(OPTIONS[name]), out, recorded.undisturbed[name])
            after = item_times(out)
            for marker in done(operations[:end], recorded.out) if name == recorded.now else ():
                assert out / marker in kept, f"{marker} is lost"
                assert after[out / marker] == kept[out / marker], f"{marker} was written again"
        except AssertionError as error:
            last = operations[end - 1]
            wrong.append(f"{seed} after {end} ({last.kind} {last.path.name}) {told(error)}")
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
