"""Trees of models from others: equal to scikit-learn's, and refused if they are damaged."""

import io
import os
import re
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from sklearn.ensemble import HistGradientBoostingClassifier
from skops.io import dumps

from flexroad.tasks import TaskError
from flexroad.tasks.segment.pixels.features import Features
from flexroad.tasks.segment.pixels.model import About, encode, read_model
from tests import fuzz
from tests.fuzz.damage import damage

NAMES = tuple("abcdef")
ABOUT = About(features=NAMES, photo=False, cell_m=1, threshold=0.5, scikit_learn="1", trained={})


def cells(n=900) -> np.ndarray:
    values = np.random.default_rng(0).normal(size=(n, len(NAMES))).astype(np.float32)
    values[::7, 2] = np.nan
    return values


def fitted(rounds=10) -> HistGradientBoostingClassifier:
    values = cells()
    classifier = HistGradientBoostingClassifier(max_iter=rounds, random_state=0, early_stopping=False)
    return classifier.fit(values, values[:, 0] + np.nan_to_num(values[:, 2]) > 0)


@pytest.fixture(scope="module")
def whole() -> bytes:
    return encode(ABOUT, fitted())


def predicted(path: Path) -> np.ndarray:
    """Read a model and use it on 30 x 30 cells."""
    values = cells().T.reshape(len(NAMES), 30, 30)
    return read_model(path).probability(Features(NAMES, values), np.ones((30, 30), bool)).ravel()


def repacked(content: bytes, change: Callable[[str, bytes], bytes]) -> bytes:
    """Return a model's file with changed members."""
    target = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(target, "w", 8) as new:
        for name in old.namelist():
            new.writestr(name, change(name, old.read(name)))
    return target.getvalue()


def written(tmp_path: Path, content: bytes) -> Path:
    path = tmp_path / "model.skops"
    path.write_bytes(content)
    return path


def with_nodes(change: Callable[[np.ndarray], None]) -> bytes:
    classifier = fitted()
    change(classifier._predictors[3][0].nodes)
    return encode(ABOUT, classifier)


def fails(path: Path, match: str) -> None:
    with pytest.raises(TaskError, match=match) as caught:
        predicted(path)
    assert str(path) in str(caught.value)
    assert "`flexroad train" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_probability_equals_that_of_scikit_learn(tmp_path, whole):
    expected = fitted().predict_proba(cells())[:, 1].astype(np.float32)
    np.testing.assert_array_equal(predicted(written(tmp_path, whole)), expected)


@pytest.mark.parametrize(
    ("field", "node", "number", "reason"),
    [
        ("left", 0, 0, "nodes that are no tree"),
        ("left", 0, 2**31, "nodes that are no tree"),
        ("right", 0, 2**32 - 1, "nodes that are no tree"),
        ("right", 0, 1, "nodes that are no tree"),
        ("is_leaf", 0, 1, "nodes that are no tree"),
        ("is_leaf", -1, 0, "nodes that are no tree"),
        ("feature_idx", 0, len(NAMES), "a feature beyond its 6"),
        ("feature_idx", 0, -1, "a feature beyond its 6"),
        ("num_threshold", 0, np.nan, "not a number"),
        ("value", -1, np.inf, "not a number"),
        ("is_categorical", 0, 1, "splits by categories"),
    ],
)
def test_read_damaged_node_raises(tmp_path, field, node, number, reason):
    def change(nodes):
        nodes[field][node] = number

    fails(written(tmp_path, with_nodes(change)), f"tree 3 .*{reason}")


def test_read_nodes_of_other_type_or_size_raises(tmp_path):
    for nodes in (np.zeros(3), np.zeros((0,), fitted()._predictors[0][0].nodes.dtype), np.zeros(10**6, "u1")):
        classifier = fitted()
        classifier._predictors[3][0].nodes = nodes
        fails(written(tmp_path, encode(ABOUT, classifier)), "tree 3 has no field|an array has")


def test_read_header_with_more_elements_than_the_file_raises(tmp_path, whole):
    def change(name, content):
        return re.sub(rb"\((\d+),\), }    ", rb"(99\1,), }  ", content, count=1)

    fails(written(tmp_path, repacked(whole, change)), "an array has 99")


@pytest.mark.parametrize("member", ["schema.json", "strange.npy"])
def test_read_zip_bomb_raises_without_unpacking(tmp_path, whole, member, monkeypatch):
    monkeypatch.setattr(zipfile.ZipFile, "testzip", lambda _: pytest.fail("it was unpacked"))
    path = written(tmp_path, whole)
    with zipfile.ZipFile(path, "a", 8) as archive:
        archive.writestr(member, b"")
        archive.getinfo(member).file_size = 2**40
    fails(path, "would unpack to 1,099,511,")


def test_read_does_not_create_objects_of_the_file(tmp_path, whole):
    """The type that scikit-learn would be asked for does not matter: only arrays are read."""
    about = ABOUT.model_dump_json()
    fails(
        written(tmp_path, dumps({"about": about, "classifier": Path("/tmp").joinpath})), "its classifier is a"
    )
    fails(written(tmp_path, dumps({"about": about, "classifier": 3})), "its classifier is a")
    strange = repacked(whole, lambda _, content: content.replace(b'"_BinMapper"', b'"Popen"'))
    np.testing.assert_array_equal(predicted(written(tmp_path, strange)), predicted(written(tmp_path, whole)))


def test_read_pipe_raises_at_once(tmp_path):
    os.mkfifo(tmp_path / "model.skops")
    fails(tmp_path / "model.skops", "is not a file")


def with_damaged_nodes(whole: bytes, rng: np.random.Generator) -> bytes:
    """Return a model whose archive is valid, but the nodes of some trees are not."""

    def change(name: str, content: bytes) -> bytes:
        if b"is_leaf" not in content[:500] or rng.random() < 0.8:
            return content
        start = content.index(b"\n") + 1
        return content[:start] + damage(content[start:], rng)

    return repacked(whole, change)


@pytest.mark.slow
def test_read_damaged_at_random_raises_or_predicts(tmp_path, whole):
    path = written(tmp_path, whole)
    fuzz.check(__name__, "predicted", fuzz.damaged(whole, 100, 1), path)


@pytest.mark.slow
def test_read_damaged_nodes_raises_or_predicts(tmp_path, whole):
    copies = (with_damaged_nodes(whole, np.random.default_rng(seed)) for seed in range(200))
    fuzz.check(__name__, "predicted", copies, written(tmp_path, whole))


@pytest.mark.slow
def test_read_damaged_schema_raises_or_predicts(tmp_path, whole):
    with zipfile.ZipFile(io.BytesIO(whole)) as archive:
        schema = archive.read("schema.json")
    copies = (
        repacked(whole, lambda name, old, new=new: new if name == "schema.json" else old)
        for new in fuzz.damaged(schema, 100, 2)
    )
    fuzz.check(__name__, "predicted", copies, written(tmp_path, whole))
