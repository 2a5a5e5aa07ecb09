"""A fault at every operation on a file of a run: the next run gives the results of an undisturbed one.

By default a sample of the operations has a fault; with the environment variable ``FLEXROAD_ALL_FAULTS=1``
each of them, which takes about ten minutes (``pytest -s`` then prints the numbers).
"""

import json
import os
import signal
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from flexroad.pipeline.run.lock import Owner
from flexroad.tools.synthetic.scenes import write_scenes
from tests import command_line
from tests.builders import LIGHT
from tests.faulty_files import FAULTS, Faulty, Operation, intercepted
from tests.whole_run import assert_whole, item_times, temporary_files

pytestmark = [pytest.mark.slow, pytest.mark.soak("runs")]

SAMPLE = 12
"""Operations that have a fault, of each kind of fault."""


@pytest.fixture(scope="module")
def words(tmp_path_factory) -> list:
    """A run command of two adjacent tiles, without the run folder."""
    folder = tmp_path_factory.mktemp("small")
    write_scenes(folder, 2, seed=3, size_m=60)
    (folder / "light.yaml").write_text(yaml.safe_dump(LIGHT, sort_keys=False))
    catalog = folder / "catalog.parquet"
    return ["run", "--config", folder / "light.yaml", "--catalog", catalog, "--executor", "serial", "--out"]


@pytest.fixture(scope="module")
def undisturbed(words, tmp_path_factory) -> tuple[Path, list[Operation]]:
    """A finished run without faults, and its operations."""
    out, counting = tmp_path_factory.mktemp("undisturbed") / "run", Faulty(-1, lambda: None)
    command_line.call(*words, tmp_path_factory.mktemp("first") / "run").expected(0)
    with intercepted(out, counting):
        command_line.call(*words, out).expected(0)
    return out, counting.met


def run_with(fault: Faulty, words: list, out: Path) -> command_line.Said:
    with intercepted(out, fault):
        return command_line.call(*words, out)


def killed_with(fault: Faulty, words: list, out: Path) -> None:
    """Run in a copy of this process, which ends itself."""
    assert command_line.forked(lambda: run_with(fault, words, out).code) == -signal.SIGKILL


def check_after_error(said: command_line.Said, out: Path, fault: Faulty, undisturbed: Path) -> None:
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


def check_next(words: list, out: Path, undisturbed: Path) -> None:
    """The next run is complete, and keeps tiles that were finished."""
    if (out / "lock.json").exists():
        # The process that could not remove its lock would have ended by then.
        ended = replace(Owner.me(), pid=2**22 + 1)
        (out / "lock.json").write_bytes(ended.data)
    finished, logged = item_times(out), runs_in_log(out)
    with intercepted(out, lambda operation: None):
        command_line.call(*words, out).expected(0)
    if temporary_files(out):
        command_line.call("clean", out).expected(0)
    assert_whole(out, undisturbed)
    assert finished.items() <= item_times(out).items()
    assert runs_in_log(out) == logged + 1


def spread(total: int) -> list[int]:
    """All positions, or a sample that includes the first and the last."""
    if os.environ.get("FLEXROAD_ALL_FAULTS"):
        return list(range(total))
    return sorted({round(i * (total - 1) / (SAMPLE - 1)) for i in range(SAMPLE)})


@pytest.mark.parametrize("kind", FAULTS)
def test_run_fault_at_any_write_next_run_is_whole(kind, words, undisturbed, tmp_path):
    whole, operations = undisturbed
    wrong, codes = [], Counter[int]()
    for at in spread(len(operations)):
        out, fault = tmp_path / str(at) / "run", FAULTS[kind](at)
        try:
            if kind == "killed":
                killed_with(fault, words, out)
                assert len(temporary_files(out)) <= 1
            else:
                said = run_with(fault, words, out)
                codes[said.code] += 1
                check_after_error(said, out, fault, whole)
            check_next(words, out, whole)
        except AssertionError as error:
            first = str(error).strip().splitlines() or [repr(error)]
            wrong.append(f"{at} {operations[at].kind} {operations[at].path.name}: {' '.join(first)[:300]}")
    print(f"{kind}: {len(spread(len(operations)))} of {len(operations)}, exit codes {dict(codes)}")  # noqa: T201
    assert not wrong, "\n".join(wrong)
