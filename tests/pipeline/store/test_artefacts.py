"""Artefacts and products are read back exactly as written; damaged ones count as missing."""

import hashlib
import itertools
import json
from dataclasses import fields

import numpy as np
import pytest

from flexroad.catalog import Catalog
from flexroad.catalog.storage import paths
from flexroad.catalog.storage.paths import write
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.graph.graph import Pattern
from flexroad.pipeline.store.artefacts import DAMAGED, HEADER, ArtefactStore, decode, encode
from flexroad.pipeline.store.products import TileProducts, file_entry
from flexroad.pipeline.worker.evaluator import Evaluator
from flexroad.tasks.io.archive import npz

CONFIG = {
    "fit": {"method": "nurbs", "control_points": [12, 12], "iterations": 5},
    "variants": {
        "plane": {"fit": "plane"},
        "raster": {"fit": "raster"},
        "flexroad": {},
        "moving": {"fit": {"plan": "moving"}},
    },
}


def same(a, b) -> bool:
    if isinstance(a, np.ndarray):
        return (
            a.dtype == b.dtype
            and b.flags.c_contiguous
            and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
        )
    if isinstance(a, float):
        return type(b) is float and (a == b or (a != a and b != b))
    return type(a) is type(b) and a == b


@pytest.fixture
def evaluator(survey, tmp_path):
    graph = Pattern.of(compose(CONFIG, "x")).graph(Catalog.read(survey).tiles[0])
    return Evaluator(graph, ArtefactStore(tmp_path / "store"), keep=True)


def test_codec_restores_every_result_exactly(evaluator):
    kinds = set()
    for fingerprint, node in evaluator.graph.nodes.items():
        if node.stage == "load":
            continue
        value = evaluator(fingerprint)
        back, seconds, notes = decode(encode(value, {"fit": 0.25}, ("dsm: a note",), ""), "")
        assert (seconds, notes) == ({"fit": 0.25}, ("dsm: a note",))
        assert type(back) is type(value)
        for field in fields(value):
            assert same(getattr(value, field.name), getattr(back, field.name)), (node.stage, field.name)
        kinds.add(type(value).__name__)
    assert kinds == {
        "RoadMask", "RoadClusters", "PlaneSurface", "RasterSurface", "NurbsSurface", "MovingNurbs", "Mesh",
            "Metrics", "Quality",
    }  # fmt: skip


def test_decode_any_damaged_byte_or_truncation_raises(evaluator):
    """Also in the parts of a zip that have no checksum: names, dates and directory."""
    node = evaluator.graph.nodes[evaluator.graph.variants["plane"]["evaluate"]]
    evaluator(node.fingerprint)
    (path,) = evaluator.store.root.rglob(f"{node.fingerprint}.npz")
    whole = path.read_bytes()
    assert decode(whole, node.fingerprint)
    flips = (whole[:i] + bytes([whole[i] ^ 1 << i % 8]) + whole[i + 1 :] for i in range(len(whole)))
    cuts = (whole[:i] for i in range(len(whole)))
    for damaged in (*flips, *cuts, whole + b"0"):
        with pytest.raises(DAMAGED):
            decode(damaged, node.fingerprint)
    assert evaluator.store.get(node) is not None
    path.write_bytes(whole[:-1])
    assert evaluator.store.get(node) is None


def test_artefact_under_another_name_is_missing(evaluator):
    """Also one of the same type, which no error would betray."""
    nodes = [node for node in evaluator.graph.nodes.values() if node.stored]
    for node in nodes:
        evaluator(node.fingerprint)
    paths = {path.stem: path for path in evaluator.store.root.rglob("*.npz")}
    contents = {name: path.read_bytes() for name, path in paths.items()}
    assert all(evaluator.store.get(node) for node in nodes)
    for node, other in itertools.product(nodes, repeat=2):
        paths[node.fingerprint].write_bytes(contents[other.fingerprint])
        assert (evaluator.store.get(node) is None) == (node is not other)


def test_artefact_of_another_type_is_computed_again(evaluator):
    graph, store = evaluator.graph, evaluator.store
    nodes = [node for node in graph.nodes.values() if node.stored]
    right = {node.fingerprint: evaluator(node.fingerprint) for node in nodes}
    for node in nodes:
        of_other = next(value for value in right.values() if type(value) is not type(right[node.fingerprint]))
        if node.stage == "fit":
            of_other = right[graph.variants["plane"]["evaluate"]]
        store.put(node, of_other, {}, ())
        assert store.get(node) is None, node.stage
    again = Evaluator(graph, store)
    for node in nodes:
        assert type(again(node.fingerprint)) is type(right[node.fingerprint])


EMPTY = {"type": "Metrics", "seconds": {}, "notes": []}


@pytest.mark.parametrize("header", [[], {"type": "Metrics"}, EMPTY, EMPTY | {"fields": []}])
def test_artefact_with_another_header_is_missing(header, evaluator):
    node = evaluator.graph.nodes[evaluator.graph.variants["plane"]["evaluate"]]
    payload = npz({HEADER: np.frombuffer(json.dumps(header).encode(), np.uint8)})
    checksum = hashlib.sha256(payload + node.fingerprint.encode()).digest()
    write(
        evaluator.store.root / node.stage / node.fingerprint[:2] / f"{node.fingerprint}.npz",
        payload + checksum,
    )
    assert evaluator.store.get(node) is None


def test_marker_of_another_tile_is_none(tmp_path):
    one, other = (TileProducts.of(tmp_path, name) for name in ("1_1", "1_2"))
    item = {"id": "1_1", "properties": {"flexroad:nodes": {"flexroad": {"fit": "abc"}}}, "assets": {}}
    one.finish(item, {})
    assert one.marker("item.json") == item
    assert one.nodes("flexroad") == {"fit": "abc"}
    other.path.mkdir()
    (one.path / "item.json").rename(other.path / "item.json")
    assert other.marker("item.json") is None
    assert other.nodes("flexroad") == {}
    assert not other.verified()
    other.fail({"tile": "1_2"})
    assert other.marker("failed.json") == {"tile": "1_2"}
    (other.path / "failed.json").rename(one.path / "failed.json")
    assert one.marker("failed.json") is None


def test_artefact_opens_with_numpy(evaluator):
    fingerprint = evaluator.graph.variants["flexroad"]["segment"]
    mask = evaluator(fingerprint).mask
    (path,) = evaluator.store.root.rglob(f"{fingerprint}.npz")
    with np.load(path) as archive:
        assert np.array_equal(archive["mask"], mask)


def test_verified_changed_product_is_false(tmp_path):
    folder = TileProducts(tmp_path / "tile")
    item = {"id": "tile", "assets": {"mesh.glb": file_entry("mesh.glb", b"abc", "model/gltf-binary")}}
    folder.finish(item, {"mesh.glb": b"abc"})
    assert folder.verified()
    for damaged in (b"abd", b"ab", b""):
        (folder.path / "mesh.glb").write_bytes(damaged)
        assert not folder.verified()
    (folder.path / "mesh.glb").unlink()
    assert not folder.verified()


def test_finish_interrupted_leaves_tile_not_done(tmp_path, monkeypatch):
    """Also if writing a product fails, for example if access is denied."""
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
