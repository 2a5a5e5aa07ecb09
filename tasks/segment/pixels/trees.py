"""The trees of a model: read from its file, checked and evaluated.

A file may come from others, so nothing that it names is created: of the skops archive only the JSON of its
schema and the arrays of the nodes are read, within limits, and every node is checked before it is used.
"""

from __future__ import annotations

import io
import json
import math
from dataclasses import dataclass
from typing import Any, BinaryIO
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from flexroad.tasks.compiled import compiled
from flexroad.tasks.types import Bools, Floats

MOST_TREES = 5000
"""Greatest number of trees that training makes."""
MOST_LEAVES = 255
"""Greatest number of leaves of a tree that training makes."""
MOST_SCHEMA, MOST_BYTES = 2**25, 2**28
"""Limits of the schema and of the whole archive, unpacked (bytes); a model of the largest options has
15 and 150 MiB."""
MOST_HEADER = 2000
"""Longest header of an array (bytes); that of the nodes has about 400."""
CLASSIFIER = "HistGradientBoostingClassifier"
FIELDS = {
    "value": "f",
    "num_threshold": "f",
    "feature_idx": "iu",
    "left": "iu",
    "right": "iu",
    "missing_go_to_left": "iu",
    "is_leaf": "iu",
    "is_categorical": "iu",
}
"""The fields of a node that predictions need, and the kinds of their numbers."""

Indices = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Trees:
    """All nodes of a classifier; `check` holds for them, so every path from a root ends in a leaf."""

    roots: Indices
    """Index of the first node of each tree."""
    feature: Indices
    threshold: Floats
    """A cell goes left if its feature is not above the threshold of the node."""
    missing_left: Bools
    """Whether a cell without that feature goes left."""
    left: Indices
    """Index of the left child; -1 in leaves."""
    right: Indices
    value: Floats
    """Added to the logit in a leaf."""
    baseline: float
    """Logit before the first tree."""

    def probability(self, features: NDArray[np.float32]) -> Floats:
        """Return the probability of road from the features of cells, ``(n, features)`` -> ``(n,)``."""
        from scipy.special import expit

        nodes = self.feature, self.threshold, self.missing_left, self.left, self.right, self.value
        result: Floats = expit(_logits(np.ascontiguousarray(features), self.roots, *nodes, self.baseline))
        return result


def read_archive(file: BinaryIO) -> tuple[str, list[NDArray[np.void]], float]:
    """Return the metadata, the nodes of each tree and the baseline of a model's file.

    Raises
    ------
    Exception
        Of many types, if the file is damaged or is not a model.
    """
    if file.seek(0, io.SEEK_END) > MOST_BYTES:
        raise ValueError(f"it has more than {MOST_BYTES >> 20} MiB")
    with ZipFile(file) as archive:
        _check_sizes(archive)
        schema = json.loads(archive.read("schema.json"))
        about = json.loads(schema["content"]["about"]["content"])
        classifier = schema["content"]["classifier"]
        if classifier.get("__class__") != CLASSIFIER:
            raise TypeError(f"its classifier is a {str(classifier.get('__class__'))[:50]}")
        state = classifier["content"]["content"]
        rounds = state["_predictors"]["content"]
        if not 1 <= len(rounds) <= MOST_TREES:
            raise ValueError(f"it has {len(rounds)} trees, not 1 to {MOST_TREES}")
        trees = []
        for number, one_round in enumerate(rounds):
            if len(one_round["content"]) != 1:
                raise ValueError(f"it has {len(one_round['content'])} trees in round {number}, not one")
            name = one_round["content"][0]["content"]["content"]["nodes"]["file"]
            trees.append(_array(archive.read(name), 2 * MOST_LEAVES - 1))
        baseline = _array(archive.read(state["_baseline_prediction"]["file"]), 1)
    if not isinstance(about, str):
        raise TypeError("its metadata are not text")
    return about, trees, float(baseline[0])


def _check_sizes(archive: ZipFile) -> None:
    """Check the sizes of all members before any is unpacked, then their checksums."""
    members = archive.infolist()
    if any(member.compress_type not in (ZIP_STORED, ZIP_DEFLATED) for member in members):
        raise ValueError("its compression is not that of a model")
    size, schema = sum(member.file_size for member in members), archive.getinfo("schema.json").file_size
    if size > MOST_BYTES or schema > MOST_SCHEMA:
        raise ValueError(f"it would unpack to {size:,} bytes, {schema:,} of them for its schema")
    damaged = archive.testzip()
    if damaged is not None:
        raise ValueError(f"{damaged[:50]} is damaged")


def _array(content: bytes, most: int) -> NDArray[Any]:
    """Return the elements of an array in NumPy's format, at most ``most``."""
    file = io.BytesIO(content)
    read_header = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}[npy.read_magic(file)]
    shape, _, dtype = read_header(file, max_header_size=MOST_HEADER)
    size = math.prod(shape)
    if not 1 <= size <= most or dtype.hasobject or len(content) - file.tell() != size * dtype.itemsize:
        raise ValueError(f"an array has {size} elements of {dtype.itemsize} bytes in {len(content)} bytes")
    return np.frombuffer(content, dtype, size, file.tell())


def assemble(trees: list[NDArray[np.void]], baseline: float, features: int) -> Trees:
    """Return the trees of a classifier of ``features`` features.

    Raises
    ------
    ValueError
        If a tree does not pass `check`, or the baseline is not finite.
    """
    if not math.isfinite(baseline):
        raise ValueError(f"its baseline is {baseline}")
    parts = [_fields(nodes, number) for number, nodes in enumerate(trees)]
    for number, part in enumerate(parts):
        check(part, features, number)
    sizes = [len(nodes) for nodes in trees]
    roots = np.cumsum([0, *sizes[:-1]])
    whole = {name: np.concatenate([part[name] for part in parts]) for name in FIELDS}
    inner, shift = whole["is_leaf"] == 0, np.repeat(roots, sizes)
    left, right = (np.where(inner, whole[side] + shift, -1).astype(np.int32) for side in ("left", "right"))
    return Trees(
        roots.astype(np.int32),
        np.where(inner, whole["feature_idx"], 0).astype(np.int32),
        whole["num_threshold"],
        whole["missing_go_to_left"] != 0,
        left,
        right,
        whole["value"],
        baseline,
    )


def _fields(nodes: NDArray[np.void], number: int) -> dict[str, NDArray[Any]]:
    """Return the fields of a tree's nodes as float64 and int64."""
    fields: Any = nodes.dtype.fields or {}
    parts: dict[str, NDArray[Any]] = {}
    for name, kinds in FIELDS.items():
        if name not in fields or fields[name][0].kind not in kinds:
            raise ValueError(f"tree {number} has no field {name}")
        parts[name] = nodes[name].astype(np.float64 if kinds == "f" else np.int64)
    return parts


def check(nodes: dict[str, NDArray[Any]], features: int, number: int) -> None:
    """Check that the nodes of a tree are one tree: each but the first is the child of one node before it.

    Raises
    ------
    ValueError
        If they are not, a feature does not exist, a threshold is NaN, or the value of a leaf is not finite.
    """
    inner = np.flatnonzero(nodes["is_leaf"] == 0)
    children = np.concatenate([nodes["left"][inner], nodes["right"][inner]])
    if (children <= np.tile(inner, 2)).any() or not np.array_equal(
        np.sort(children), np.arange(1, len(nodes["is_leaf"]))
    ):
        raise ValueError(f"tree {number} has nodes that are no tree")
    feature, threshold = nodes["feature_idx"][inner], nodes["num_threshold"][inner]
    if ((feature < 0) | (feature >= features)).any():
        raise ValueError(f"tree {number} splits by a feature beyond its {features}")
    if nodes["is_categorical"][inner].any():
        raise ValueError(f"tree {number} splits by categories")
    # A threshold of infinity is valid: it splits cells with the feature from those without.
    if np.isnan(threshold).any() or not np.isfinite(nodes["value"][nodes["is_leaf"] != 0]).all():
        raise ValueError(f"tree {number} has a threshold or a value that is not a number")


@compiled()
def _logits(
    features: NDArray[np.float32],
    roots: Indices,
    feature: Indices,
    threshold: Floats,
    missing_left: Bools,
    left: Indices,
    right: Indices,
    value: Floats,
    baseline: float,
) -> Floats:
    """Return the sum of the baseline and one leaf of each tree, in the order of the trees, ``(n,)``."""
    result = np.full(features.shape[0], baseline)
    for root in roots:
        for cell in range(features.shape[0]):
            node = root
            while left[node] >= 0:
                x = features[cell, feature[node]]
                goes_left = missing_left[node] if np.isnan(x) else x <= threshold[node]
                node = left[node] if goes_left else right[node]
            result[cell] += value[node]
    return result
