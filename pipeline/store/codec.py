"""Turn a stage's result into bytes and back, exactly: arrays as they are, the rest as JSON, in one npz.

The SHA-256 of it all stands behind the zip, where readers of npz files do not mind it: a damaged artefact is
told on reading. No pickle: a store may be shared.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping
from dataclasses import asdict, fields, is_dataclass
from typing import Any

import numpy as np

from flexroad.catalog import Grid
from flexroad.pipeline.config.methods import methods
from flexroad.tasks.spline.surface import NurbsSurface
from flexroad.tasks.types import Mesh, Metrics, Quality, RoadClusters, RoadMask

HEADER = "header.json"
SHA256_BYTES = 32


def encode(value: Any, seconds: Mapping[str, float]) -> bytes:
    """Return the bytes of a result; ``seconds`` tells what each stage up to it took."""
    arrays: dict[str, Any] = {}
    plain: dict[str, Any] = {}
    for field in fields(value):
        item = getattr(value, field.name)
        if isinstance(item, np.ndarray):
            arrays[field.name] = item
        else:
            plain[field.name] = {"grid": asdict(item)} if isinstance(item, Grid) else item
    header = {"type": type(value).__name__, "seconds": dict(seconds), "fields": plain}
    buffer = io.BytesIO()
    arrays[HEADER] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    np.savez_compressed(buffer, **arrays)
    payload = buffer.getvalue()
    return payload + hashlib.sha256(payload).digest()


def decode(data: bytes) -> tuple[Any, dict[str, float]]:
    """Return the result and the seconds that each stage up to it took.

    Raises
    ------
    ValueError, KeyError, OSError, zipfile.BadZipFile, zlib.error
        If the bytes are damaged or of an unknown kind.
    """
    payload, checksum = data[:-SHA256_BYTES], data[-SHA256_BYTES:]
    if hashlib.sha256(payload).digest() != checksum:
        raise ValueError("the checksum is not that of the bytes")
    with np.load(io.BytesIO(payload), allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    header = json.loads(arrays.pop(HEADER).tobytes())
    plain = {name: _plain(item) for name, item in header["fields"].items()}
    return _types()[header["type"]](**plain, **arrays), header["seconds"]


def _plain(item: Any) -> Any:
    if isinstance(item, dict):
        return Grid(**item["grid"])
    # Frozen types hold tuples where JSON knows only lists.
    return tuple(_plain(part) for part in item) if isinstance(item, list) else item


def _types() -> dict[str, type]:
    kinds = (Mesh, Metrics, NurbsSurface, Quality, RoadClusters, RoadMask)
    known: dict[str, type] = {kind.__name__: kind for kind in kinds}
    for module in methods("fit").values():
        known |= {k: v for k, v in vars(module).items() if k.endswith("Surface") and is_dataclass(v)}
    return known
