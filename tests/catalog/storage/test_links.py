"""Which paths `contained` takes, beside the literal definition: both sides with all links resolved."""

import itertools
import os
from pathlib import Path

import pytest

from flexroad.catalog.storage.paths import contained


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A folder with links in it, behind a link."""
    real = tmp_path / "real"
    (real / "a" / "b").mkdir(parents=True)
    (real / "a" / "file").touch()
    (tmp_path / "other").mkdir()
    (real / "inside").symlink_to(real / "a")
    (real / "outside").symlink_to(tmp_path / "other")
    (real / "a" / "up").symlink_to("..")
    (real / "a" / "lost").symlink_to(tmp_path / "missing")
    (real / "round").symlink_to(real / "round")
    (tmp_path / "home").symlink_to(real)
    return tmp_path / "home"


PARTS = ("a", "b", "..", "file", "up", "inside", "outside", "lost", "round", "missing")


def test_contained_takes_what_is_below_the_folder_with_all_links_resolved(home):
    paths = [Path(home, *parts) for count in range(4) for parts in itertools.product(PARTS, repeat=count)]
    paths += [home.parent / "real" / "a", home.parent / "homes", home.parent]
    taken = 0
    for path in paths:
        below = os.path.relpath(os.path.realpath(path), os.path.realpath(home))
        if below.split("/")[0] == "..":
            with pytest.raises(OSError, match="a link leads to"):
                contained(path, home)
        else:
            assert contained(path, home) == path
            taken += 1
    assert len(paths) / 4 < taken < len(paths)


def test_contained_null_byte_raises_as_for_any_path(home):
    for path in (home / "a" / "b\0", home / ".." / "\0"):
        with pytest.raises(ValueError, match="null byte"):
            contained(path, home)
