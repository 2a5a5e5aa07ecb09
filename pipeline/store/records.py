"""What is known of one tile of a run: what its marker says, in the fields that tables and resumes need."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any, Literal

MetricsRow = dict[str, Any]
State = Literal["done", "failed"]
MarkerStat = tuple[str, int, int | str]
"""Name, size and version (time or ETag) of the file that an entry was read from, or written to."""

DONE, FAILED = "item.json", "failed.json"
MARKERS: dict[State, str] = {"done": DONE, "failed": FAILED}


@dataclass(frozen=True)
class Failure:
    """Why a tile has no result."""

    tile_id: str
    stage: str
    kind: str
    message: str
    file: str = ""
    trace: str = ""
    """The traceback, for faults that are not the input's."""

    @property
    def line(self) -> str:
        """One line for tables."""
        return f"{self.stage}: {self.kind}: {self.message}"

    @property
    def notice(self) -> str:
        """One line for people: tile, what is wrong, and the file at fault."""
        return f"{self.tile_id}: {self.line}{f'  [{self.file}]' if self.file else ''}"


@dataclass(frozen=True)
class TileRecord:
    """How a tile went when it was last tried."""

    tile_id: str
    state: State
    fingerprint: str
    """Of the graph that was carried out."""
    rows: tuple[MetricsRow, ...]
    failures: tuple[Failure, ...] = ()
    sources: list[Any] = field(default_factory=list)
    """The source layers as `TileGraph.sources` named them."""
    sizes: dict[str, int] = field(default_factory=dict)
    """Bytes of each product, by file name."""
    finished: str = ""
    """When, as ISO 8601 in UTC."""
    seconds: float = 0.0
    """What computing it took, in the worker."""
    marker: MarkerStat | None = None
    """None where none could be written, as on a full disk."""


def from_item(item: dict[str, Any], marker: MarkerStat | None) -> TileRecord:
    """Return what a STAC item of a finished tile says.

    Raises
    ------
    KeyError, TypeError, AttributeError
        If it is damaged: a marker without its rows is, whatever else it holds.
    """
    told = item["properties"]
    return TileRecord(
        item["id"],
        "done",
        told["flexroad:fingerprint"],
        tuple(told["flexroad:rows"]),
        sources=told.get("flexroad:sources") or [],
        sizes={asset["href"]: asset["file:size"] for asset in item["assets"].values()},
        finished=told.get("created", ""),
        seconds=told.get("flexroad:seconds", 0.0),
        marker=marker,
    )


def to_failed(entry: TileRecord) -> dict[str, Any]:
    """Return what failed.json holds."""
    return {
        "tile": entry.tile_id,
        "fingerprint": entry.fingerprint,
        "failures": [asdict(failure) for failure in entry.failures],
        "rows": list(entry.rows),
        "finished": entry.finished,
        "seconds": entry.seconds,
    }


def from_failed(found: dict[str, Any], marker: MarkerStat | None) -> TileRecord:
    """Return what failed.json says.

    Raises
    ------
    KeyError, TypeError
        If it is damaged.
    """
    return TileRecord(
        found["tile"],
        "failed",
        found["fingerprint"],
        tuple(found["rows"]),
        tuple(Failure(**failure) for failure in found["failures"]),
        finished=found.get("finished", ""),
        seconds=found.get("seconds", 0.0),
        marker=marker,
    )
