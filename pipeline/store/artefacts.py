"""Artefacts: the results of stages, stored by fingerprint.

Every file of a store or run is written to a temporary name in the same folder and then renamed, or put into
a bucket by one request. A reader therefore reads a complete file or none, even if the writer was killed. ::

    STORE/<stage>/<ab>/<fingerprint>.npz        artefacts
    RUN/tiles/<tile>/<tile>_<variant>.glb ...   products
    RUN/tiles/<tile>/item.json                  STAC item with rows and checksums, written last: tile done
    RUN/tiles/<tile>/failed.json                written instead if a stage failed
"""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from flexroad.catalog.storage import paths
from flexroad.catalog.storage.links import contained
from flexroad.catalog.storage.paths import Location
from flexroad.pipeline.graph.graph import Node
from flexroad.pipeline.store import codec
from flexroad.tasks.spline.frame import Corner, Edge
from flexroad.tasks.types import Mesh, Metrics, Quality, RoadClusters, RoadMask, Surface

DAMAGED = (OSError, ValueError, KeyError, TypeError, AttributeError, EOFError, zipfile.BadZipFile, zlib.error)
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

    def get(self, node: Node) -> codec.Stored | None:
        """Return a result with the seconds and notes up to it, None if it is missing or damaged."""
        return self.find(node.stage, node.fingerprint)

    def find(self, stage: str, fingerprint: str) -> codec.Stored | None:
        """Return what `get` returns, for a node of which only stage and fingerprint are known."""
        try:
            found = codec.decode(paths.read(self._path(stage, fingerprint)), fingerprint)
        except DAMAGED:
            # A damaged artefact counts as missing: it is computed and written again.
            return None
        return found if isinstance(found.value, RESULTS[stage]) else None

    def put(self, node: Node, value: Any, seconds: Mapping[str, float], notes: Sequence[str]) -> int:
        """Store a result with the seconds of each stage and the notes up to it; return the size in bytes."""
        data = codec.encode(value, seconds, notes, node.fingerprint)
        paths.write(self._path(node.stage, node.fingerprint), data)
        return len(data)

    def has(self, node: Node) -> bool:
        """Return whether the artefact exists; its content is not checked."""
        try:
            return paths.exists(self._path(node.stage, node.fingerprint))
        except OSError:
            # To store it then raises the error.
            return False

    def _path(self, stage: str, fingerprint: str) -> Location:
        """Return the file of an artefact; OSError if it lies behind a link that leads out of the store."""
        return contained(self.root / stage / fingerprint[:2] / f"{fingerprint}.npz", self.root)
