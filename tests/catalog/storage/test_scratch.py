"""Temporary folders are removed when their process ends; those of killed processes by a later one."""

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from flexroad.catalog.storage.scratch import LOCK, ScratchFolder, abandoned, remove_abandoned

PROCESS = """
import sys, time
from flexroad.catalog.storage.scratch import ScratchFolder
with ScratchFolder() as folder:
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


def test_folder_of_killed_process_is_removed_and_that_of_living_kept(temporary):
    process = subprocess.Popen([sys.executable, "-c", PROCESS, "wait"], stdout=subprocess.PIPE, text=True)
    try:
        name = process.stdout.readline().strip()
        with ScratchFolder() as own:
            assert remove_abandoned() == 0
            process.send_signal(signal.SIGKILL)
            process.wait()
            assert list(map(str, abandoned())) == [name]
            assert remove_abandoned() == 1
            assert names(temporary) == [Path(own).name]
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


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
    code = PROCESS.replace("    print", f"{start}    print")
    process = subprocess.Popen([sys.executable, "-c", code, "wait"], stdout=subprocess.PIPE, text=True)
    process.stdout.readline()
    process.kill()
    process.wait()
    process.stdout.close()
    assert remove_abandoned() == 1
