"""A run is written to an empty or new folder or to that of a run, also of a damaged one."""

import pytest

from flexroad.catalog.storage import paths
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.record import check_folder
from flexroad.pipeline.run.summary import Summary, write_summary
from tests.permissions import permissions_enforced


@pytest.fixture(params=["disk", pytest.param("bucket", marks=pytest.mark.slow)])
def folder(request, tmp_path):
    return tmp_path if request.param == "disk" else request.getfixturevalue("bucket")


def fill(folder, *names):
    for name in names:
        paths.write(folder / name, b"mine")


@pytest.mark.parametrize(
    "names",
    [
        ["catalog.parquet", "config.yaml", "height.vrt", "collection.json"],
        ["tiles/32_356_5699.tif"],
        ["store/readme.txt"],
        ["summary.json"],
        ["lock.json", "log.jsonl", "notes.txt"],
    ],
)
def test_folder_with_files_of_others_is_refused(folder, names):
    fill(folder, *names)
    before = paths.listing(folder)
    other = min(name.partition("/")[0] for name in names if not name.startswith(("lock", "log")))
    message = (
        f"{folder} has files that are not of a run, such as {other}; choose an empty or new folder with --out"
    )
    with pytest.raises(ConfigError) as refusal:
        check_folder(folder)
    assert str(refusal.value) == message
    assert paths.listing(folder) == before


@pytest.mark.parametrize(
    "names", [[], [".DS_Store", ".Trash-0/a", "lost+found/a"], ["lock.json", "log.jsonl"]]
)
def test_folder_without_files_of_others_is_accepted(folder, names):
    fill(folder, *names)
    check_folder(folder)
    check_folder(folder / "new" / "run")


@pytest.mark.parametrize(
    "name", ["run.json", "tiles/a/item.json", "tiles/b/failed.json", "store/fit/ab/ab.npz", "SUMMARY"]
)
def test_folder_with_one_sign_of_a_run_is_accepted(folder, name):
    fill(folder, "config.yaml", "notes.txt")
    if name == "SUMMARY":
        write_summary(folder, Summary(1, 1, 0, 0, 0))
    else:
        fill(folder, name)
    check_folder(folder)


def test_folder_that_cannot_be_read_is_refused(tmp_path):
    (tmp_path / "run").mkdir(mode=0o000)
    with permissions_enforced(), pytest.raises(ConfigError, match="cannot read .*run: Permission denied; "):
        check_folder(tmp_path / "run")
