"""The only writer of results: artefacts by fingerprint, and tiles whose marker is written last.

Everything is written to a temporary name in the same folder and then renamed, or put into a bucket by one
request, so that a reader sees a whole file or none, whatever killed the writer. ::

    STORE/<stage>/<ab>/<fingerprint>.npz
    RUN/tiles/<tile>/<tile>_<variant>.glb ...   the products
    RUN/tiles/<tile>/item.json                  STAC item with rows and checksums, last: the tile is done
    RUN/tiles/<tile>/failed.json                instead, if a stage failed
"""

from __future__ import annotations

import uuid
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from flexroad.catalog.storage import paths
from flexroad.catalog.storage.paths import Location
from flexroad.pipeline.graph.graph import Node
from flexroad.pipeline.store import codec

DAMAGED = (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error)


@dataclass(frozen=True)
class ArtefactStore:
    """Results of stages by fingerprint; may be shared by runs."""

    root: Location

    def get(self, node: Node) -> tuple[Any, dict[str, float]] | None:
        """Return a result and what each stage up to it took, or None if it is not there or damaged."""
        try:
            return codec.decode(paths.read(self._path(node)))
        except DAMAGED:
            # What cannot be read is as good as absent: it is computed and written anew.
            return None

    def put(self, node: Node, value: Any, seconds: Mapping[str, float]) -> int:
        """Keep a result and what each stage up to it took; return how many bytes that is."""
        data = codec.encode(value, seconds)
        paths.write(self._path(node), data)
        return len(data)

    def has(self, node: Node) -> bool:
        """Tell whether a result is there, unread."""
        return paths.exists(self._path(node))

    def _path(self, node: Node) -> Location:
        return self.root / node.stage / node.fingerprint[:2] / f"{node.fingerprint}.npz"


def check_writable(folder: Location) -> None:
    """Fail early if nothing can be written below ``folder``.

    Raises
    ------
    OSError
        With the reason and the path.
    """
    probe = folder / f".probe-{uuid.uuid4().hex}"
    paths.write(probe, b"")
    paths.remove(probe)
