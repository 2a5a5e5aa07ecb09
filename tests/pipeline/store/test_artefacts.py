"""What is written comes back to the last bit, or counts as not there."""

from dataclasses import fields

import numpy as np
import pytest

from flexroad.catalog import Catalog
from flexroad.catalog.storage import paths
from flexroad.catalog.storage.paths import write
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.graph.graph import tile_graph
from flexroad.pipeline.store import codec
from flexroad.pipeline.store.artefacts import DAMAGED, ArtefactStore
from flexroad.pipeline.store.products import TileProducts, file_entry
from flexroad.pipeline.worker.evaluator import Evaluator

CONFIG = {
    "fit": {"method": "nurbs", "control_points": [12, 12], "iterations": 5},
    "variants": {"plane": {"fit": "plane"}, "raster": {"fit": "raster"}, "flexroad": {}},
}


def same(a, b) -> bool:
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    if isinstance(a, float):
        return type(b) is float and (a == b or (a != a and b != b))
    return type(a) is type(b) and a == b


@pytest.fixture
def pull(survey, tmp_path):
    graph = tile_graph(Catalog.read(survey).tiles[0], compose(CONFIG, "x"))
    return Evaluator(graph, ArtefactStore(tmp_path / "store"), keep=True)


def test_every_result_comes_back_exactly(pull):
    kinds = set()
    for fingerprint, node in pull.graph.nodes.items():
        if node.stage == "load":
            continue
        value = pull(fingerprint)
        back, seconds = codec.decode(codec.encode(value, {"fit": 0.25}))
        assert seconds == {"fit": 0.25}
        assert type(back) is type(value)
        for field in fields(value):
            assert same(getattr(value, field.name), getattr(back, field.name)), (node.stage, field.name)
        kinds.add(type(value).__name__)
    assert kinds == {
        "RoadMask", "RoadClusters", "PlaneSurface", "RasterSurface", "NurbsSurface", "Mesh", "Metrics",
            "Quality",
    }  # fmt: skip


def test_damage_counts_as_absence(pull):
    fingerprint = pull.graph.variants["flexroad"]["fit"]
    node = pull.graph.nodes[fingerprint]
    pull(fingerprint)
    (path,) = (pull.store.root / "fit").rglob(f"{fingerprint}.npz")
    whole = path.read_bytes()
    assert pull.store.get(node) is not None
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 0xFF
    for damaged in (b"", whole[:100], whole[:-1], bytes(flipped)):
        path.write_bytes(damaged)
        assert pull.store.get(node) is None


def test_every_damaged_byte_and_every_cut_is_noticed(pull):
    """Also where the zip keeps no checksum of its own: in its names, dates and directory."""
    node = pull.graph.nodes[pull.graph.variants["plane"]["evaluate"]]
    pull(node.fingerprint)
    (path,) = pull.store.root.rglob(f"{node.fingerprint}.npz")
    whole = path.read_bytes()
    assert codec.decode(whole)
    flips = (whole[:i] + bytes([whole[i] ^ 1 << i % 8]) + whole[i + 1 :] for i in range(len(whole)))
    cuts = (whole[:i] for i in range(len(whole)))
    for damaged in (*flips, *cuts, whole + b"0"):
        with pytest.raises(DAMAGED):
            codec.decode(damaged)


def test_an_artefact_opens_without_us(pull):
    fingerprint = pull.graph.variants["flexroad"]["segment"]
    mask = pull(fingerprint).mask
    (path,) = pull.store.root.rglob(f"{fingerprint}.npz")
    with np.load(path) as archive:
        assert np.array_equal(archive["mask"], mask)


def test_a_product_with_one_other_byte_is_not_verified(tmp_path):
    folder = TileProducts(tmp_path / "tile")
    item = {"assets": {"mesh.glb": file_entry("mesh.glb", b"abc", "model/gltf-binary")}}
    folder.finish(item, {"mesh.glb": b"abc"})
    assert folder.verified()
    for damaged in (b"abd", b"ab", b""):
        (folder.path / "mesh.glb").write_bytes(damaged)
        assert not folder.verified()
    (folder.path / "mesh.glb").unlink()
    assert not folder.verified()


def test_nothing_vouches_for_a_mixture_of_old_and_new_products(tmp_path, monkeypatch):
    """A run that is killed between two products, or denied the second, leaves a tile that is not done."""
    folder = TileProducts(tmp_path / "tile")
    folder.finish({"was": 1}, {"a": b"old", "b": b"old"})

    def denied(path, data):
        if path.name == "b":
            raise PermissionError(13, "denied", str(path))
        path.write_bytes(data)

    monkeypatch.setattr(paths, "write", denied)
    with pytest.raises(PermissionError):
        folder.finish({"is": 1}, {"a": b"new", "b": b"new"})
    assert sorted(path.name for path in folder.path.iterdir()) == ["a", "b"]


def test_a_failed_write_leaves_what_was_there(tmp_path, monkeypatch):
    path = tmp_path / "a" / "b.json"
    write(path, b"old")
    with pytest.raises(TypeError):
        write(path, "not bytes")
    assert path.read_bytes() == b"old"
    assert [p.name for p in path.parent.iterdir()] == ["b.json"]


def test_a_marker_of_another_graph_or_with_a_product_missing_is_not_done(survey, tmp_path):
    graph = tile_graph(Catalog.read(survey).tiles[0], compose(CONFIG, "x"))
    folder = TileProducts.of(tmp_path, graph.tile.id)
    item = {
        "properties": {"flexroad:fingerprint": graph.fingerprint, "flexroad:rows": []},
        "assets": {"mesh": {"href": "mesh.glb", "file:size": 3}},
    }
    folder.finish(item, {"mesh.glb": b"abc"})
    assert folder.done(graph) == item
    (folder.path / "mesh.glb").write_bytes(b"ab")
    assert folder.done(graph) is None
    (folder.path / "mesh.glb").write_bytes(b"abc")
    other = tile_graph(graph.tile, compose({**CONFIG, "sample": {"road_m": 2}}, "x"))
    assert folder.done(other) is None
    (folder.path / "item.json").write_text("{")
    assert folder.done(graph) is None


def test_tile_ids_become_safe_folder_names(tmp_path):
    for odd in ("../up", "a/b", "..", "", "ä b"):
        folder = TileProducts.of(tmp_path, odd).path
        assert folder.parent == tmp_path / "tiles"
        assert folder.name
    assert TileProducts.of(tmp_path, "a/b").path != TileProducts.of(tmp_path, "a-b").path
    assert TileProducts.of(tmp_path, "295500_5629250").path.name == "295500_5629250"
