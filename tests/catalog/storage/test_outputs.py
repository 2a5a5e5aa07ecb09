"""Folders of outputs are made with their parents, and do not stay if nothing is written."""

import pytest

from flexroad.catalog.storage.outputs import made_folder


def test_made_folder_stays_with_its_parents(tmp_path):
    for _ in range(2):
        with made_folder(tmp_path / "new" / "city"):
            assert (tmp_path / "new" / "city").is_dir()
    assert (tmp_path / "new" / "city").is_dir()


def fails_after(*files):
    for file in files:
        file.write_text("mine")
    raise KeyboardInterrupt


def test_made_folder_of_failed_block_is_removed_if_empty(tmp_path):
    with pytest.raises(KeyboardInterrupt), made_folder(tmp_path / "new" / "city"):
        fails_after()
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(KeyboardInterrupt), made_folder(tmp_path / "new" / "city"):
        fails_after(tmp_path / "new" / "notes.txt")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["new", "notes.txt"]


def test_made_folder_that_existed_stays_after_failure(tmp_path):
    with pytest.raises(KeyboardInterrupt), made_folder(tmp_path):
        fails_after()
    assert tmp_path.is_dir()


def test_made_folder_that_is_a_file_raises(tmp_path):
    (tmp_path / "city").write_text("mine")
    with pytest.raises(FileExistsError, match="city"), made_folder(tmp_path / "city"):
        pass
    assert (tmp_path / "city").read_text() == "mine"
