"""Artefacts: the results of stages, stored by fingerprint.

Every file of a store or run is written to a temporary name in the same folder and renamed, or put into
a bucket by one request. A reader therefore never reads an incomplete file, even if the writer was killed. ::

    STORE/<stage>/<ab>/<fingerprint>.npz        artefacts
    RUN/tiles/<tile>/<tile>_<variant>.glb ...   products
    RUN/tiles/<tile>/item.json                  STAC item with rows and checksums, written last: tile done
    RUN/tiles/<tile>/failed.json                written instead if a stage failed

An artefact is an npz with the arrays of a result and a JSON header. The SHA-256 of the npz and of its
fingerprint is appended to it, where npz readers ignore it. It detects damaged and wrongly named files. No
pickle is used, because a store may be shared.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass
from typing import Any, NamedTuple

import numpy as np
import shapely

from flexroad.catalog import Grid
from flexroad.catalog.storage import paths
from flexroad.catalog.storage.paths import Location, contained
from flexroad.pipeline.config.stages import methods
from flexroad.pipeline.graph.graph import Node
from flexroad.tasks.io.archive import npz
from flexroad.tasks.products.npz import DAMAGED
from flexroad.tasks.spline.frame import Corner, Edge
from flexroad.tasks.spline.levelled import LevelledSurface
from flexroad.tasks.spline.moving import MovingNurbs
from flexroad.tasks.spline.stepped import SteppedSurface
from flexroad.tasks.spline.surface import NurbsSurface
from flexroad.tasks.types import (
    Level,
    LevelSpline,
    Mesh,
    Metrics,
    Quality,
    RoadClusters,
    RoadMask,
    Structures,
    Surface,
)

RESULTS: dict[str, tuple[type, ...]] = {
    "segment": (RoadMask,),
    "ecsrc": (RoadClusters,),
    "border": (Corner, Edge),
    "fit": (Surface,),
    "sample": (Mesh,),
    "evaluate": (Metrics,),
    "assess": (Quality,),
}
"""The types of result of each stage."""


@dataclass(frozen=True)
class ArtefactStore:
    """Results of stages by fingerprint; runs may share a store."""

    root: Location

    def get(self, node: Node) -> Stored | None:
        """Return a result with its seconds and notes (`Stored`), None if it is missing or damaged."""
        return self.find(node.stage, node.fingerprint)

    def find(self, stage: str, fingerprint: str) -> Stored | None:
        """Do as `get`, for a node of which only stage and fingerprint are known."""
        try:
            found = decode(paths.read(self._path(stage, fingerprint)), fingerprint)
        except DAMAGED:
            # A damaged artefact is treated as missing: it is computed and written again.
            return None
        return found if isinstance(found.value, RESULTS[stage]) else None

    def put(self, node: Node, value: Any, seconds: Mapping[str, float], notes: Sequence[str]) -> int:
        """Store a result with its seconds and notes (`Stored`); return the size in bytes."""
        data = encode(value, seconds, notes, node.fingerprint)
        paths.write(self._path(node.stage, node.fingerprint), data)
        return len(data)

    def has(self, node: Node) -> bool:
        """Return whether the artefact exists; its content is not checked."""
        try:
            return paths.exists(self._path(node.stage, node.fingerprint))
        except OSError:
            # The error is raised again when the result is stored.
            return False

    def _path(self, stage: str, fingerprint: str) -> Location:
        """Return the file of an artefact; OSError if it lies behind a link that leads out of the store."""
        return contained(self.root / stage / fingerprint[:2] / f"{fingerprint}.npz", self.root)


HEADER = "header.json"
SEPARATOR = "."
"""Separates the names of a field and of a nested field in the names of arrays."""
CHANGES = ".changes"
"""End of the name of faces stored as differences from the face before, which take a quarter of the bytes."""
LEVELS = ("level", "levels", "structures")
"""Fields that are left out if they are empty: most results have no levels."""
SHA256_BYTES = 32


class Stored(NamedTuple):
    """A result with the time and the notes of its computation."""

    value: Any
    seconds: dict[str, float]
    """Computing time of each stage up to it (s)."""
    notes: tuple[str, ...]
    """Notes on the sources of all stages up to it."""


def encode(value: Any, seconds: Mapping[str, float], notes: Sequence[str], fingerprint: str) -> bytes:
    """Return a result with its seconds and notes (`Stored`) as bytes."""
    arrays: dict[str, Any] = {}
    plain = _fields(value, "", arrays)
    header = {"type": type(value).__name__, "seconds": dict(seconds), "notes": list(notes), "fields": plain}
    arrays[HEADER] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    payload = npz(arrays)
    return payload + _checksum(payload, fingerprint)


def decode(data: bytes, fingerprint: str) -> Stored:
    """Return the result with its seconds and notes from the bytes of `encode`."""
    payload, checksum = data[:-SHA256_BYTES], data[-SHA256_BYTES:]
    if _checksum(payload, fingerprint) != checksum:
        raise ValueError("the checksum does not match the data and its fingerprint")
    with np.load(io.BytesIO(payload), allow_pickle=False) as archive:
        arrays = dict(_arrays(archive))
    header = json.loads(arrays.pop(HEADER).tobytes())
    value = _result(header["type"], header["fields"], "", arrays)
    return Stored(value, header["seconds"], tuple(header["notes"]))


def _checksum(payload: bytes, fingerprint: str) -> bytes:
    checksum = hashlib.sha256(payload)
    checksum.update(fingerprint.encode())
    return checksum.digest()


def _fields(value: Any, prefix: str, arrays: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a result as JSON values, and add its arrays to ``arrays`` by name."""
    plain: dict[str, Any] = {}
    for field in fields(value):
        item, name = getattr(value, field.name), prefix + field.name
        if isinstance(item, np.ndarray):
            arrays |= _compact(name, item)
        elif item or field.name not in LEVELS:
            plain[field.name] = _json(item, name, arrays)
    return plain


def _compact(name: str, array: np.ndarray) -> dict[str, np.ndarray]:
    """Return an array in the form that has the smallest file, with its name in the file."""
    if array.shape[1:] != (3,):
        return {name: array}
    if array.dtype.kind == "i":
        return {name + CHANGES: np.diff(array, axis=0, prepend=np.zeros((1, 3), array.dtype))}
    # Points stored by columns are a quarter smaller, because many have the same x or y.
    return {name: np.asfortranarray(array)}


def _arrays(archive: Mapping[str, np.ndarray]) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the arrays of a file by name, in the form before `_compact`."""
    for name, array in archive.items():
        if name.endswith(CHANGES):
            yield name.removesuffix(CHANGES), np.cumsum(array, axis=0, dtype=array.dtype)
        else:
            yield name, np.asarray(array, order="C")


def _json(item: Any, name: str, arrays: dict[str, Any]) -> Any:
    if isinstance(item, Grid):
        return {"grid": asdict(item)}
    if isinstance(item, shapely.Geometry):
        arrays[name] = np.frombuffer(shapely.to_wkb(item), np.uint8)
        return {"wkb": name}
    if is_dataclass(item):
        return {
            "result": type(item).__name__,
            "prefix": name + SEPARATOR,
            "fields": _fields(item, name + SEPARATOR, arrays),
        }
    if isinstance(item, tuple):
        return [_json(part, f"{name}{SEPARATOR}{number}", arrays) for number, part in enumerate(item)]
    return item


def _result(kind: str, plain: Mapping[str, Any], prefix: str, arrays: Mapping[str, Any]) -> Any:
    """Return a result from its JSON fields and from the arrays whose names begin with a prefix."""
    own = {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
    own = {name: array for name, array in own.items() if SEPARATOR not in name and name not in plain}
    return _types()[kind](**{name: _plain(item, arrays) for name, item in plain.items()}, **own)


def _plain(item: Any, arrays: Mapping[str, Any]) -> Any:
    if isinstance(item, dict):
        if "grid" in item:
            return Grid(**item["grid"])
        if "wkb" in item:
            return shapely.from_wkb(arrays[item["wkb"]].tobytes())
        return _result(item["result"], item["fields"], item["prefix"], arrays)
    # The result types have tuples, which JSON stores as lists.
    return tuple(_plain(part, arrays) for part in item) if isinstance(item, list) else item


def _types() -> dict[str, type]:
    shared = (
        Corner, Edge, Level, LevelledSurface, LevelSpline, Mesh, Metrics, MovingNurbs, NurbsSurface, Quality,
        RoadClusters, RoadMask, SteppedSurface, Structures,
    )  # fmt: skip
    types: dict[str, type] = {result.__name__: result for result in shared}
    for module in methods("fit").values():
        types |= {k: v for k, v in vars(module).items() if k.endswith("Surface") and is_dataclass(v)}
    return types
