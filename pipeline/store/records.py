"""The record of one tile of a run: the part of its marker for tables and resumed runs."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from typing import Any, Literal

from flexroad.tasks.metrics.evaluate import FIGURES
from flexroad.tasks.quality.assess import NO_ROAD

MetricsRow = dict[str, Any]
"""One row of metrics.parquet, by column; with decks or tunnels also the tile's rows of levels.csv."""
LEVELS = "levels"
"""Key of the rows of levels.csv in a row."""
MeshDistances = dict[str, dict[str, float]]
"""Largest distances of meshes from their surfaces (m), by variant and column of metrics.parquet."""
TileState = Literal["cached", "done", "failed", "pending"]
"""cached: already done when the last run started; pending: no result for the current files and options."""
MarkerStat = tuple[str, int, int | str]
"""Name, size (bytes) and version (time or ETag) of a tile's marker file."""

CHECKSUM = "flexroad:checksum"
DONE, FAILED = "item.json", "failed.json"
MARKERS: dict[TileState, str] = {"done": DONE, "failed": FAILED}
"""Name of the marker file of each state with a marker."""


@dataclass(frozen=True)
class Failure:
    """An error that left a tile without a result."""

    tile_id: str
    stage: str
    kind: str
    message: str
    file: str = ""
    trace: str = ""
    """The traceback; empty for expected errors, such as invalid input."""

    @property
    def line(self) -> str:
        """Stage, kind and message in one line, for tables."""
        return f"{self.stage}: {self.kind}: {self.message}"

    @property
    def notice(self) -> str:
        """Tile, error and file in one line, for the command line and reports."""
        return f"{self.tile_id}: {self.line}{f'  [{self.file}]' if self.file else ''}"


@dataclass(frozen=True)
class TileRecord:
    """The result of a tile's last attempt."""

    tile_id: str
    state: TileState
    """``done`` or ``failed``."""
    fingerprint: str
    """Fingerprint of the graph that was computed."""
    rows: tuple[MetricsRow, ...]
    failures: tuple[Failure, ...] = ()
    sources: list[Any] = field(default_factory=list)
    """`TileGraph.sources` of that graph."""
    sizes: dict[str, int] = field(default_factory=dict)
    """Size of each product in bytes, by file name."""
    finished: str = ""
    """Time of completion, ISO 8601 in UTC."""
    seconds: float = 0.0
    """Computing time in the worker (s)."""
    marker: MarkerStat | None = None
    """None if the marker could not be written, for example on a full disk."""
    stale: tuple[str, ...] = ()
    """Names of the products of an earlier result that a failed tile still has."""
    renamed: dict[str, str] = field(default_factory=dict)
    """Names of results that were computed without an unusable file, by fingerprint (`TileGraph.renamed`)."""
    left_out: tuple[str, ...] = ()
    """Files that could not be used when the tile was finished, by layer and name in the catalog."""

    @property
    def has_products(self) -> bool:
        """Whether the tile's folder has products: its own, or stale ones."""
        return bool(self.sizes or self.stale)

    @property
    def without_roads(self) -> bool:
        """Whether the tile is done and no variant has a road on it."""
        flags = [(row.get("flags") or "").split(", ") for row in self.rows]
        return self.state == "done" and bool(flags) and all(NO_ROAD in names for names in flags)

    @property
    def flagged(self) -> tuple[str, ...]:
        """The variants that have flags (`needs_look`)."""
        return tuple(row["variant"] for row in self.rows if needs_look(row.get("flags")))


def needs_look(flags: object) -> bool:
    """Return whether a row with these flags should be looked at: it has a flag other than `NO_ROAD`."""
    return isinstance(flags, str) and not {*flags.split(", ")} <= {"", NO_ROAD}


def from_item(item: dict[str, Any], marker: MarkerStat | None) -> TileRecord:
    """Return the record of a finished tile from its STAC item."""
    properties = item["properties"]
    return TileRecord(
        item["id"],
        "done",
        properties["flexroad:fingerprint"],
        tuple(properties["flexroad:rows"]),
        sources=properties.get("flexroad:sources") or [],
        sizes={asset["href"]: asset["file:size"] for asset in item["assets"].values()},
        finished=properties.get("created", ""),
        seconds=properties.get("flexroad:seconds", 0.0),
        marker=marker,
        renamed=dict(properties.get("flexroad:renamed") or {}),
        left_out=tuple(properties.get("flexroad:left_out", ())),
    )


def to_failed(entry: TileRecord) -> dict[str, Any]:
    """Return the content of failed.json."""
    return {
        "tile": entry.tile_id,
        "fingerprint": entry.fingerprint,
        "failures": [asdict(failure) for failure in entry.failures],
        "rows": list(entry.rows),
        "finished": entry.finished,
        "seconds": entry.seconds,
        "stale": list(entry.stale),
    }


def from_failed(content: dict[str, Any], marker: MarkerStat | None) -> TileRecord:
    """Return the record of a failed tile from the content of its failed.json."""
    return TileRecord(
        content["tile"],
        "failed",
        content["fingerprint"],
        tuple(content["rows"]),
        tuple(Failure(**failure) for failure in content["failures"]),
        finished=content.get("finished", ""),
        seconds=content.get("seconds", 0.0),
        marker=marker,
        stale=tuple(content.get("stale", ())),
    )


def with_distances(rows: Iterable[MetricsRow], largest: MeshDistances) -> Iterator[MetricsRow]:
    """Yield the rows, and put their largest distances into ``largest``; rows of failed tiles have none."""
    for row in rows:
        for name, value in distances_of(row).items():
            own = largest.setdefault(row["variant"], {})
            own[name] = max(value, own.get(name, 0.0))
        yield row


def distances_of(row: MetricsRow) -> dict[str, float]:
    """Return the distances of a mesh from its surface (m) in a row, by column."""
    return {name: row[name] for name in FIGURES if isinstance(row.get(name), float | int)}


def no_nan(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return the row with None for NaN and infinities, which JSON cannot represent."""
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in row.items()}


def utc_now() -> str:
    """Return the current time in UTC, ISO 8601 with milliseconds."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def dump_checked(content: dict[str, Any]) -> bytes:
    """Return an object as JSON with a checksum, because a flipped bit in a number leaves valid JSON.

    If the checksum is wrong, the content is computed or written again.
    """
    return json.dumps({**content, CHECKSUM: _checksum(content)}, indent=1, allow_nan=False).encode()


def load_checked(data: bytes) -> dict[str, Any]:
    """Return the object that `dump_checked` has written, without the checksum."""
    try:
        content = json.loads(data)
    except RecursionError as error:
        raise ValueError("nested too deep") from error
    if not isinstance(content, dict) or content.pop(CHECKSUM, None) != _checksum(content):
        raise ValueError("the checksum does not agree")
    return content


def _checksum(content: dict[str, Any]) -> str:
    """Return the checksum of the values: spaces and the order of keys do not matter."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()
