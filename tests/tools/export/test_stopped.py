"""An export that is stopped anywhere leaves nothing half-written, and the same command completes it."""

import errno
import os
import signal
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest

from flexroad.pipeline.execute import DaskExecutor
from flexroad.tools.export.driver import BEGUN, export
from flexroad.tools.export.formats import FORMATS
from flexroad.tools.export.source import select
from tests import command_line
from tests.faulty_files import Operation, intercepted
from tests.whole_run import temporary_files

from .conftest import OPTIONS, contents

pytestmark = [pytest.mark.slow, pytest.mark.soak("exports")]

POINTS = 5
"""Operations at which each format is stopped."""
KILL_S = 300
"""Longest time of an export that is to be killed (s)."""


@dataclass
class At:
    """An observer that acts at one operation, and, if it lasts, at all later ones that need space.

    Operations on the lock do not count: a process that is killed before it has named the owner in its lock
    leaves one that is waited for, which the tests of the lock show.
    """

    number: int
    act: Callable[[], None]
    lasting: bool = False
    met: list[Operation] = field(default_factory=list)

    def __call__(self, operation: Operation) -> None:
        if operation.path.name == "lock.json":
            return
        self.met.append(operation)
        later = (
            self.lasting and operation.kind in ("create", "write", "mkdir") and len(self.met) > self.number
        )
        if len(self.met) == self.number + 1 or later:
            self.act()


def full() -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def words(city, name, out):
    # The run's tiles do not meet.
    return ["export", city.path, "--format", name, "--vertical", "47.5", "--allow-steps", "-o", out]


@pytest.fixture(scope="module")
def whole(made_city, tmp_path_factory):
    """Exports without faults in all formats, and the number of operations of each."""
    folder, numbers = tmp_path_factory.mktemp("whole"), {}
    for name in FORMATS:
        counting = At(-1, lambda: None)
        with intercepted(folder / name, counting):
            command_line.call(*words(made_city, name, folder / name)).expected(0)
        numbers[name] = len(counting.met)
    return folder, numbers


def points(number: int) -> list[int]:
    """Operations of an export, spread over it."""
    return sorted({round(k * (number - 1) / (POINTS - 1)) for k in range(POINTS)})


def goes_on(city, name, out, whole) -> None:
    command_line.call(*words(city, name, out)).expected(0)
    assert contents(out / name) == contents(whole / name / name)
    assert not [path for path in temporary_files(out) if path.name not in (f".{name}.json", BEGUN)]
    assert not (out / "lock.json").exists()


@pytest.mark.parametrize("lasting", [False, True])
@pytest.mark.parametrize("name", FORMATS)
def test_full_disk_gives_one_line_and_nothing_half_written(made_city, whole, tmp_path, name, lasting):
    folder, numbers = whole
    whole_files = contents(folder / name / name)
    for number in points(numbers[name]):
        out = tmp_path / str(number)
        with intercepted(out, At(number, full, lasting)):
            said = command_line.call(*words(made_city, name, out))
        if said.code or lasting:
            assert said.code == 2
            (line,) = said.errors
            assert "No space left on device" in line
            assert not (out / "export.json").exists()
        for file, content in contents(out / name).items():
            assert content == whole_files[file], f"{file} is not complete after operation {number}"
        goes_on(made_city, name, out, folder)


@pytest.mark.parametrize("name", FORMATS)
def test_killed_export_goes_on_to_the_same_bytes(made_city, whole, tmp_path, name):
    folder, numbers = whole
    for number in points(numbers[name]):
        out = tmp_path / str(number)
        if child := os.fork():
            _, status = os.waitpid(child, 0)
            assert os.WIFSIGNALED(status), "the export was not killed"
            assert os.WTERMSIG(status) == signal.SIGKILL
        else:
            try:
                signal.alarm(KILL_S)
                with intercepted(out, At(number, lambda: os.kill(os.getpid(), signal.SIGKILL))):
                    command_line.call(*words(made_city, name, out))
            finally:
                os._exit(0)
        goes_on(made_city, name, out, folder)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("name", FORMATS)
def test_interrupted_export_has_exit_code_130_and_goes_on(made_city, whole, tmp_path, name, number):
    folder, numbers = whole
    out = tmp_path / "out"
    with intercepted(out, At(numbers[name] // 2, lambda: os.kill(os.getpid(), number))):
        said = command_line.call(*words(made_city, name, out))
    assert said.code == 130
    assert said.err.splitlines()[-1] == "interrupted; the same command goes on from here"
    assert not temporary_files(out / name) or (out / name / ".pieces").exists()
    assert not (out / "lock.json").exists()
    goes_on(made_city, name, out, folder)


def test_dask_writes_the_same_bytes(made_city, whole, cluster, tmp_path):
    executor = DaskExecutor(scheduler=cluster.scheduler_address)
    # With OpenCRG in the same export, OpenDRIVE refers to it: that of `whole` does not.
    export(select(made_city.path), tmp_path, [name for name in FORMATS if name != "xodr"], OPTIONS, executor)
    export(select(made_city.path), tmp_path, ["xodr"], OPTIONS, executor)
    for name in FORMATS:
        assert contents(tmp_path / name) == contents(whole[0] / name / name), name


def test_workers_that_are_gone_end_the_export_with_exit_code_1(made_city, tmp_path, monkeypatch, flexroad):
    from flexroad.pipeline.errors import ClusterLost
    from flexroad.pipeline.execute import SerialExecutor

    def gone(*_):
        raise ClusterLost("no worker was left for 300 s")
        yield

    monkeypatch.setattr(SerialExecutor, "map", gone)
    said = flexroad(*words(made_city, "obj", tmp_path))
    assert said.code == 1
    assert said.errors == ["error: no worker was left for 300 s; the same command goes on from here"]
