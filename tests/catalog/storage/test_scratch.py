"""Temporary folders are removed when their process ends; a later process removes those that a kill left."""

import os
import subprocess
import sys
import tempfile
from contextlib import contextmanager
from pathlib import Path

import pytest

from flexroad.catalog.storage import scratch
from flexroad.catalog.storage.scratch import LOCK, ScratchFolder, abandoned, remove_abandoned

PROCESS = """
import sys, time
from pathlib import Path
from flexroad.catalog.storage.scratch import ScratchFolder
with ScratchFolder(*map(Path, sys.argv[2:])) as folder:
    print(folder, flush=True)
    time.sleep(600 if "wait" in sys.argv else 0)
"""


@pytest.fixture(autouse=True)
def temporary(tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return tmp_path


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_folder_is_removed_at_the_end(temporary):
    with ScratchFolder() as name:
        assert names(temporary) == [Path(name).name]
        assert not list(abandoned())
    kept = ScratchFolder()
    kept.cleanup()
    subprocess.run([sys.executable, "-c", PROCESS], check=True, stdout=subprocess.DEVNULL)
    assert names(temporary) == []


@contextmanager
def waiting(*parents, code=PROCESS):
    """Start a process that has a folder; yield it with the folder's path."""
    command = [sys.executable, "-c", code, "wait", *parents]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process, Path(process.stdout.readline().strip())
        finally:
            process.kill()


def test_folder_of_killed_process_is_removed_and_that_of_living_kept(temporary):
    with waiting() as (process, path), ScratchFolder() as own:
        assert remove_abandoned() == 0
        process.kill()
        process.wait()
        assert list(abandoned()) == [path]
        assert remove_abandoned() == 1
        assert names(temporary) == [Path(own).name]


def test_folder_in_parent_is_hidden_and_those_of_killed_processes_are_removed(temporary):
    parent = temporary / "parent"
    parent.mkdir()
    with waiting(parent) as (process, path):
        with ScratchFolder(parent) as first, ScratchFolder(parent) as second:
            living = {Path(first).name, Path(second).name, path.name}
            assert set(names(parent)) == living
            assert all(hidden.startswith(".flexroad-") for hidden in living)
        assert names(parent) == [path.name]
        process.kill()
        process.wait()
        (parent / ".flexroad-before-its-lock").mkdir()
        (parent / ".flexroad-data").mkdir()
        (parent / ".flexroad-data" / "file").touch()
        with ScratchFolder(parent) as own:
            assert names(parent) == sorted([Path(own).name, ".flexroad-data"])


@pytest.mark.parametrize("at", ["open", "flock", "fstat"])
def test_folder_that_another_process_removes_before_its_lock_is_made_again(temporary, monkeypatch, at):
    module = scratch.fcntl if at == "flock" else os
    plain, taken = getattr(module, at), []

    def late(*arguments):
        if not taken:
            (folder,) = temporary.glob(".flexroad-*")
            taken.append(folder)
            if at == "open":
                folder.rmdir()
            else:
                (folder / LOCK).unlink()
                folder.rmdir()
            if at == "flock":
                raise BlockingIOError
        return plain(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(module, at, late)
        own = ScratchFolder(temporary)
    assert names(temporary) == [Path(own.name).name]
    assert names(Path(own.name)) == [LOCK]
    assert taken != [Path(own.name)]
    own.cleanup()


def test_other_folders_and_links_are_kept(temporary):
    """Of the three kinds only a folder with a lock file that no process holds is removed."""
    outside = temporary / "outside"
    for folder in (outside, temporary / "flexroad-data", temporary / "flexroad-1"):
        folder.mkdir()
        (folder / "file").touch()
    for folder in (outside, temporary / "flexroad-1"):
        (folder / LOCK).touch()
    (temporary / "flexroad-link").symlink_to(outside)
    (temporary / "flexroad-1" / "link").symlink_to(outside)
    (temporary / "flexroad-data" / LOCK).symlink_to(outside / LOCK)
    os.mkfifo(temporary / "flexroad-pipe")
    assert remove_abandoned() == 1
    assert names(temporary) == ["flexroad-data", "flexroad-link", "flexroad-pipe", "outside"]
    assert names(outside) == [LOCK, "file"]


def test_child_without_own_folder_does_not_keep_it(temporary):
    """Programs that a process starts, and that live longer, do not inherit the lock."""
    start = "    import subprocess; subprocess.Popen(['sleep', '5'], stdout=subprocess.DEVNULL)\n"
    with waiting(code=PROCESS.replace("    print", f"{start}    print")):
        pass
    assert remove_abandoned() == 1
