"""Lossless conversion of a stage's result to bytes and back: one npz with the arrays and a JSON header.

The SHA-256 of the npz is appended to it, where npz readers ignore it; it detects damage on reading. No pickle
is used, because a store may be shared.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, is_dataclass
from typing import Any, NamedTuple

import numpy as np

from flexroad.catalog import Grid
from flexroad.pipeline.config.methods import methods
from flexroad.tasks.io.archive import npz
from flexroad.tasks.spline.frame import Corner, Edge
from flexroad.tasks.spline.moving import MovingNurbs
from flexroad.tasks.spline.stepped import SteppedSurface
from flexroad.tasks.spline.surface import NurbsSurface
from flexroad.tasks.types import Mesh, Metrics, Quality, RoadClusters, RoadMask

HEADER = "header.json"
SHA256_BYTES = 32


class Stored(NamedTuple):
    """A result with what is known of its making."""

    value: Any
    seconds: dict[str, float]
    """Computing time of each stage up to it (s)."""
    notes: tuple[str, ...]
    """Notes on the sources of all stages up to it."""


def encode(value: Any, seconds: Mapping[str, float], notes: Sequence[str] = ()) -> bytes:
    """Return the bytes of a result, of the seconds of each stage and of the notes up to it (`Stored`)."""
    arrays: dict[str, Any] = {}
    plain: dict[str, Any] = {}
    for field in fields(value):
        item = getattr(value, field.name)
        if isinstance(item, np.ndarray):
            # Points are a quarter smaller by columns: many have the same x or y.
            points = item.dtype.kind == "f" and item.shape[1:] == (3,)
            arrays[field.name] = np.asfortranarray(item) if points else item
        else:
            plain[field.name] = {"grid": asdict(item)} if isinstance(item, Grid) else item
    header = {"type": type(value).__name__, "seconds": dict(seconds), "notes": list(notes), "fields": plain}
    arrays[HEADER] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    payload = npz(arrays)
    return payload + hashlib.sha256(payload).digest()


def decode(data: bytes) -> Stored:
    """Return the result, the seconds of each stage and the notes up to it.

    Raises
    ------
    ValueError, KeyError, OSError, zipfile.BadZipFile, zlib.error
        If the bytes are damaged or of an unknown type.
    """
    payload, checksum = data[:-SHA256_BYTES], data[-SHA256_BYTES:]
    if hashlib.sha256(payload).digest() != checksum:
        raise ValueError("the checksum does not match the data")
    with np.load(io.BytesIO(payload), allow_pickle=False) as archive:
        arrays = {name: np.asarray(archive[name], order="C") for name in archive.files}
    header = json.loads(arrays.pop(HEADER).tobytes())
    plain = {name: _plain(item) for name, item in header["fields"].items()}
    # Stores of earlier versions have no notes.
    notes = tuple(header.get("notes", ()))
    return Stored(_types()[header["type"]](**plain, **arrays), header["seconds"], notes)


def _plain(item: Any) -> Any:
    if isinstance(item, dict):
        return Grid(**item["grid"])
    # The result types hold tuples, which JSON stores as lists.
    return tuple(_plain(part) for part in item) if isinstance(item, list) else item


def _types() -> dict[str, type]:
    shared = (
        Corner, Edge, Mesh, Metrics, MovingNurbs, NurbsSurface, Quality, RoadClusters, RoadMask,
        SteppedSurface,
    )  # fmt: skip
    types: dict[str, type] = {result.__name__: result for result in shared}
    for module in methods("fit").values():
        types |= {k: v for k, v in vars(module).items() if k.endswith("Surface") and is_dataclass(v)}
    return types
