"""What a comparison with the paper rests on: the figures of every tile and variant, and their data."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import pandas as pd

from pipeline.errors import ConfigError
from pipeline.report.content import FIGURES
from pipeline.run import Run
from pipeline.store import write_atomic
from pipeline.tables import read_metrics

FILE = "metrics.parquet"
KEYS = ["dataset", "classes", "tile_id", "stratum", "variant"]
KEPT: Final = "float32"
"""Type of the figures kept: they are what is printed from, so that the small file alone gives the pages."""
UNNAMED = "rasters whose catalog does not name them"


@dataclass(frozen=True, eq=False)
class Evidence:
    """The rows of one run, or of two that differ in how road is told from terrain."""

    rows: pd.DataFrame
    """`KEYS` and the paper's figures, one row per classes, tile and variant; figures of failed tiles
    are NaN."""

    @property
    def dataset(self) -> str:
        """What the figures were measured on."""
        return str(self.rows.dataset.iloc[0])

    @property
    def classes(self) -> tuple[str, ...]:
        """How road was told from terrain: the headline first."""
        return tuple(dict.fromkeys(self.rows.classes))

    @property
    def tiles(self) -> pd.DataFrame:
        """Columns ``stratum`` and ``complete``, by tile id; complete if no variant failed."""
        groups = self.rows.groupby("tile_id", sort=True)
        complete = groups.triangles.agg(lambda counts: bool(counts.notna().all()))
        return pd.DataFrame({"stratum": groups.stratum.first(), "complete": complete})

    @property
    def line(self) -> str:
        """The data, in one line."""
        done = self.tiles[self.tiles.complete]
        strata = done.stratum[done.stratum != ""].value_counts()
        parts = f" ({', '.join(f'{n} {name}' for name, n in strata.items())})" if len(strata) else ""
        failed = len(self.tiles) - len(done)
        left_out = f"; {failed} more failed and are left out" if failed else ""
        return f"Data: {self.dataset}, {len(done)} tile{'s' * (len(done) != 1)}{parts}{left_out}."

    def part(self, classes: str) -> pd.DataFrame:
        """Return the figures of the complete tiles, ``(tile, variant)`` -> figures."""
        complete = self.tiles.index[self.tiles.complete]
        rows = self.rows[(self.rows.classes == classes) & self.rows.tile_id.isin(complete)]
        return rows.set_index(["tile_id", "variant"])[list(FIGURES)].astype("float64").sort_index()


def collect(run: Run, true: Run | None = None) -> Evidence:
    """Return the figures of a run and, if given, of the same tiles classed by the true mask.

    Raises
    ------
    ConfigError
        If a run has no rows yet, mixes data, or the second is not about the same tiles and variants.
    """
    first = _rows(run)
    if true is None:
        return _sound(first, run.path)
    second = _rows(true)
    if not any(tile.layer("reference_road") for tile in true.catalog.tiles):
        raise ConfigError(f"{true.path} has no true road mask in its catalog; leave out --true")
    if set(first.classes) & set(second.classes):
        raise ConfigError(
            f"{run.path} and {true.path} both class by the {first.classes.iloc[0]} mask; "
            "--true wants a run with evaluate.classes: reference"
        )
    about = [{*zip(rows.dataset, rows.tile_id, rows.variant, strict=True)} for rows in (first, second)]
    if about[0] != about[1]:
        raise ConfigError(
            f"{true.path} is not about the data, tiles and variants of {run.path}; run both over one catalog"
        )
    return _sound(pd.concat([first, second], ignore_index=True), run.path)


def write_evidence(evidence: Evidence, folder: Path) -> None:
    """Write the figures."""
    buffer = io.BytesIO()
    kept = evidence.rows.astype(dict.fromkeys(KEYS, "category") | dict.fromkeys(FIGURES, KEPT))
    kept.to_parquet(buffer, index=False, compression="zstd")
    write_atomic(folder / FILE, buffer.getvalue())


def read_evidence(folder: Path) -> Evidence:
    """Read what `write_evidence` wrote."""
    rows = pd.read_parquet(folder / FILE)
    return Evidence(rows.astype(dict.fromkeys(KEYS, "str")))


def _rows(run: Run) -> pd.DataFrame:
    datasets = sorted({tile.dataset for tile in run.catalog.tiles})
    if len(datasets) > 1:
        raise ConfigError(
            f"{run.path} mixes data: {', '.join(name or 'unnamed' for name in datasets)}; run each by itself"
        )
    classes = sorted({chain["evaluate"].classes for chain in run.config.chains.values()})
    if len(classes) > 1:
        raise ConfigError(f"{run.path}: evaluate.classes differs between variants; a table has one")
    rows = read_metrics(run.path)
    rows = rows.assign(dataset=datasets[0] or UNNAMED, classes=classes[0])
    figures = rows[list(FIGURES)].astype("float64").where(rows.status == "done").astype(KEPT)
    return pd.concat([rows[KEYS].astype("str"), figures], axis="columns")


def _sound(rows: pd.DataFrame, run: Path) -> Evidence:
    evidence = Evidence(rows)
    if not evidence.tiles.complete.any():
        raise ConfigError(f"{run} has no tile with figures for every variant; see `flexroad status {run}`")
    return evidence
