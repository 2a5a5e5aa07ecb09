"""Products and markers are on the disk before a tile counts as done or failed."""

import os
from pathlib import Path
from types import SimpleNamespace

import pytest

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.pipeline.run.status import last_record, matches
from flexroad.pipeline.store.products import TileProducts, file_entry
from tests.conftest import QUICK
from tests.faulty_files import intercepted
from tests.power_loss import Recording, states, write_state


@pytest.fixture
def events(monkeypatch) -> list[tuple[str, str]]:
    """What is flushed and what is renamed, in this order."""
    events: list[tuple[str, str]] = []
    fsync, replace = os.fsync, Path.replace

    def flushed(file):
        name = Path(f"/proc/self/fd/{file}").readlink().name
        # A temporary file is .NAME.<32 digits>.tmp.
        events.append(("flush", name[1:-37] if name.endswith(".tmp") else name))
        fsync(file)

    def renamed(path, target):
        events.append(("name", Path(target).name))
        return replace(path, target)

    monkeypatch.setattr(os, "fsync", flushed)
    monkeypatch.setattr(Path, "replace", renamed)
    return events


def test_finish_and_fail_flush_products_then_marker_then_folders(tmp_path, events):
    folder = TileProducts.of(tmp_path, "a")
    folder.finish({"id": "a"}, {"a.glb": b"mesh", "a.tif": b"heights"}, flushed=True)
    products = [(event, name) for event in ("name", "flush") for name in ("a.glb", "a.tif")]
    marker = [("flush", "item.json"), ("name", "item.json")]
    folders = [("flush", "a"), ("flush", "tiles"), ("flush", tmp_path.name)]
    assert events == [*products, ("flush", "a"), *marker, *folders]
    events.clear()
    (tmp_path / "failed").mkdir()
    TileProducts.of(tmp_path / "failed", "a").fail({"tile": "a"}, flushed=True)
    assert events == [("flush", "failed.json"), ("name", "failed.json"), *folders[:2], ("flush", "failed")]


def test_finish_on_share_that_cannot_flush_folders_completes(tmp_path, monkeypatch):
    fsync = os.fsync

    def files_only(file):
        if Path(f"/proc/self/fd/{file}").readlink().is_dir():
            raise OSError(22, "Invalid argument")
        fsync(file)

    monkeypatch.setattr(os, "fsync", files_only)
    folder = TileProducts.of(tmp_path, "a")
    folder.finish({"id": "a"}, {}, flushed=True)
    assert (folder.path / "item.json").exists()


def _finish(folder: TileProducts, content: bytes) -> None:
    """Finish the tile with two products of the same sizes, with other contents."""
    products = {"a.glb": content, "a.tif": content * 2}
    assets = {name: file_entry(name, data, "") for name, data in products.items()}
    properties = {"flexroad:fingerprint": content.hex(), "flexroad:rows": []}
    folder.finish({"id": "a", "properties": properties, "assets": assets}, products, flushed=True)


@pytest.mark.parametrize("interrupted", [False, True], ids=["finished before", "interrupted before"])
def test_finish_power_failure_leaves_no_item_with_products_of_another(interrupted, tmp_path):
    root = tmp_path / "disk"
    before = TileProducts.of(root, "a")
    _finish(before, b"old")
    if interrupted:
        (before.path / "item.json").unlink()
    recording = Recording(root)
    with intercepted(root, recording):
        _finish(before, b"new")
    kinds = set()
    for number, state in enumerate(states(recording, 600)):
        write_state(state, root, tmp_path / str(number))
        after = TileProducts.of(tmp_path / str(number), "a")
        graphs = (SimpleNamespace(fingerprint=content.hex()) for content in (b"old", b"new"))
        files = after.files()
        record = last_record(after, None, files)
        done = [matches(record, graph, files) for graph in graphs]
        assert not any(done) or after.verified(), f"state {number}"
        kinds.add(tuple(done))
    assert len(kinds) == (2 if interrupted else 3)


@pytest.mark.parametrize("flush", [True, False])
def test_run_flushes_tiles_unless_cluster_says_not(flush, made_survey, tmp_path, events):
    tiles = Catalog.read(made_survey / "catalog.parquet").tiles[:1]
    config = compose({**QUICK, "cluster": {"flush": flush}}, "quick")
    run_tiles(Run.create(tmp_path / "run", config, Catalog(tiles)), SerialExecutor())
    assert (("flush", "item.json") in events) == flush
