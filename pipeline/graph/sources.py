"""The source files of a tile as they enter its fingerprints."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

from flexroad.catalog import Grid, Layer, Tile
from flexroad.catalog.borders import Border
from flexroad.catalog.guard.source_files import files_of, source_stat
from flexroad.catalog.storage.paths import FileStat, Location, read
from flexroad.tasks.load import READS

Stat = Callable[[Location], FileStat | None]
"""Returns the state of a source (`source_stat`), None if it does not exist."""

Recorded = Sequence[Any]
"""`SourceFiles.entries` of an earlier graph."""

File = list[Any]
"""Name, size and version of a file, or name and checksum; None if it does not exist."""
Entry = list[Any]
"""Name of a layer, its files (`File`), values, CRS and, if it has one, its conversion."""

JOINED = ',["joined"]]'
"""End of the description of several rasters: they are resampled together, unlike in earlier versions.
Fingerprints of single files stay valid."""

to_json = json.JSONEncoder(sort_keys=True, separators=(",", ":")).encode
_GRID = tuple(field.name for field in fields(Grid))


def hashed(text: str) -> str:
    """Return the first 32 hexadecimal digits of the SHA-256 of a text."""
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def names_json(fingerprints: Iterable[str]) -> str:
    """Return fingerprints as JSON; they need no escapes."""
    return "[" + ",".join([f'"{name}"' for name in fingerprints]) + "]"


def grid_json(grid: Grid) -> str:
    """Return a grid as JSON."""
    return to_json(_fields(grid))


def border_json(border: Border) -> str:
    """Return a corner or edge as JSON."""
    return to_json([border.kind, border.start, border.tile, _fields(border.grid)])


def _fields(grid: Grid) -> dict[str, Any]:
    return {name: getattr(grid, name) for name in _GRID}


@dataclass
class SourceFiles:
    """The files of a tile that its stages read: each is looked up once, when it is first needed."""

    tile: Tile
    """The tile with all its files."""
    stat_file: Stat
    checksum: bool
    """Whether bytes are hashed instead of size and time."""
    recorded: Recorded = ()
    """Entries of an earlier graph, used for files that no longer exist."""
    stats: dict[str, FileStat | None] = field(default_factory=dict)
    """Size and version of each file, by path; None if it is missing, or cannot be read to be hashed."""
    files: dict[tuple[str, str], File] = field(default_factory=dict)
    """Hashed description of each file, by layer and name."""
    texts: dict[tuple[str, str], str] = field(default_factory=dict)
    """These descriptions as JSON."""
    layers: dict[str, Layer] = field(default_factory=dict)
    """The layers of these files, by name."""
    frames: dict[str, tuple[str, str]] = field(default_factory=dict)
    """The JSON of an entry before and after its files, by name of the layer."""

    def text(self, layer: Layer, numbers: Iterable[int] | None = None) -> str:
        """Return the hashed description of a layer (`Entry`) as JSON; with ``numbers``, of these files."""
        if layer.name not in self.layers:
            self.layers[layer.name] = layer
            self.frames[layer.name] = f"[{to_json(layer.name)},[", f"],{to_json(_about(layer))[1:]}"
        start, end = self.frames[layer.name]
        names = layer.files if numbers is None else [layer.files[number] for number in numbers]
        text = f"{start}{','.join([self._text(layer.name, name) for name in names])}{end}"
        return text[:-1] + JOINED if len(names) > 1 and layer.name in READS else text

    def models(self, files: Iterable[Path]) -> str:
        """Return the checksums of files that options name, such as a model, as JSON."""
        return to_json([self._checksum(path, source_stat(path)) for path in files])

    @property
    def entries(self) -> list[Entry]:
        """The description of each layer with all its files that were looked up."""
        by_layer: dict[str, list[File]] = {}
        for (layer, _), file in self.files.items():
            by_layer.setdefault(layer, []).append(file)
        return [_entry(layer, by_layer.get(name, [])) for name, layer in self.layers.items()]

    def _text(self, layer: str, name: str) -> str:
        text = self.texts.get((layer, name))
        if text is None:
            file = self.files[layer, name] = self._file(layer, name, self.tile.path(layer, name))
            text = self.texts[layer, name] = to_json(file)
        return text

    def _file(self, layer: str, name: str, path: Location) -> File:
        found = self.stat_file(path)
        if found is not None and not self.checksum:
            self.stats[str(path)] = found
            return [name, found.size, found.version]
        # `load` reports a missing file; the fingerprint changes when the file is restored.
        file = [name, self._checksum(path, found)]
        return file if file[1] is not None else self._recorded.get((layer, name), file)

    def _checksum(self, path: Location, found: FileStat | None) -> str | None:
        """Return the SHA-256 of a file, None if it cannot be read: it is then taken as missing."""
        checksum = _checksum(path, found)
        self.stats[str(path)] = found if checksum else None
        return checksum

    @cached_property
    def _recorded(self) -> dict[tuple[str, str], File]:
        return {(name, file[0]): file for name, files, *_ in self.recorded for file in files}


def _entry(layer: Layer, files: list[File]) -> Entry:
    return [layer.name, files, *_about(layer)]


def _about(layer: Layer) -> list[Any]:
    """Return the part of an entry that does not depend on the files."""
    # Fields are added only where they are set, so that older fingerprints stay valid.
    how = [["reproject", layer.reproject, layer.height_unit]] if layer.reproject or layer.height_unit else []
    how += [["sublayer", layer.sublayer]] if layer.sublayer else []
    return [list(layer.values), layer.crs, *how]


def _checksum(path: Location, file: FileStat | None) -> str | None:
    """Return the SHA-256 of a file, None if it does not exist or cannot be read."""
    if file is None:
        return None
    try:
        return _sha256(path, file.size, file.version)
    except OSError:
        return None


@lru_cache(maxsize=65536)
def _sha256(path: Location, size: int, version: int | str) -> str:
    """Return the SHA-256 of a file, or of its parts' SHA-256; cached by path, size and version."""
    if not isinstance(path, Path):
        return hashlib.sha256(read(path)).hexdigest()
    # The version of a source is a number if it has only one file.
    parts = [path] if isinstance(version, int) else files_of(path)
    sums = []
    for part in parts:
        with part.open("rb") as file:
            sums.append(hashlib.file_digest(file, "sha256").hexdigest())
    return sums[0] if len(sums) == 1 else hashed(to_json(sums))
