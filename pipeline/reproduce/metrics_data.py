"""What a comparison with the paper rests on: the figures of every tile and variant, and their data."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import pandas as pd

from flexroad.catalog.storage.paths import Location, write
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.report.content import FIGURES
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.store.tables import frame_of, read_metrics

FILE, DSC3D_FILE = "metrics.parquet", "metrics_dsc3d.parquet"
KEYS = ["dataset", "classes", "tile_id", "stratum", "variant"]
KEPT: Final = "float32"
"""Type of the figures kept: they are what is printed from, so that the small file alone gives the pages."""
UNNAMED = "rasters whose catalog does not name them"


@dataclass(frozen=True, eq=False)
class MetricsData:
    """The rows of one run, or of two that differ in how road is told from terrain, and what stands beside."""

    rows: pd.DataFrame
    """`KEYS` and the paper's figures, one row per classes, tile and variant; figures of failed tiles
    are NaN."""
    dsc3d: tuple[MetricsData, ...] = ()
    """Runs for the rows of DSC3D, one for each reference: the paper's kind first."""

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


def collect(
    run: Run, true: Run | None = None, dsc3d: Run | None = None, dsc3d_true: Run | None = None
) -> MetricsData:
    """Return the figures of a run and, if given, of those that stand beside it.

    Parameters
    ----------
    run : Run
        The main one.
    true : Run, optional
        The same tiles classed by the true mask.
    dsc3d : Run, optional
        Scenes of DSC3D, or what stands in for them, against the reference that the paper describes.
    dsc3d_true : Run, optional
        The same scenes against the truth.

    Raises
    ------
    ConfigError
        If a run has no rows yet, mixes data, or is not about the same tiles and variants as its twin.
    """
    if dsc3d is None and dsc3d_true is not None:
        raise ConfigError(f"--dsc3d-true {dsc3d_true.path} is nothing without --dsc3d: name that run, too")
    beside = tuple(_sound(_rows(other), other.path) for other in (dsc3d, dsc3d_true) if other is not None)
    if dsc3d and dsc3d_true:
        _check_twins(dsc3d, dsc3d_true, *(data.rows for data in beside))
    first = _rows(run)
    if true is None:
        return _sound(first, run.path, beside)
    second = _rows(true)
    if not any(tile.layer("reference_road") for tile in true.catalog.tiles):
        raise ConfigError(f"{true.path} has no true road mask in its catalog; leave out --true")
    if set(first.classes) & set(second.classes):
        raise ConfigError(
            f"{run.path} and {true.path} both class by the {first.classes.iloc[0]} mask; "
            "--true wants a run with evaluate.classes: reference"
        )
    if _about(first) != _about(second) or {*first.dataset} != {*second.dataset}:
        raise ConfigError(
            f"{true.path} is not about the data, tiles and variants of {run.path}; run both over one catalog"
        )
    return _sound(pd.concat([first, second], ignore_index=True), run.path, beside)


def _check_twins(run: Run, true: Run, first: pd.DataFrame, second: pd.DataFrame) -> None:
    if _about(first) != _about(second):
        raise ConfigError(
            f"{true.path} is not about the tiles and variants of {run.path}; "
            "--dsc3d-true wants the same scenes with the true reference"
        )
    if {*first.dataset} == {*second.dataset}:
        raise ConfigError(
            f"{true.path} is about the same data as {run.path}: {first.dataset.iloc[0]}; "
            "--dsc3d-true wants the same scenes with the true reference"
        )


def _about(rows: pd.DataFrame) -> set[tuple[str, str]]:
    return {*zip(rows.tile_id, rows.variant, strict=True)}


def write_metrics_data(data: MetricsData, folder: Path) -> None:
    """Write the figures; those for DSC3D to a file of their own, if there are any."""
    write(folder / FILE, _kept(data.rows))
    if data.dsc3d:
        rows = pd.concat([beside.rows for beside in data.dsc3d], ignore_index=True)
        write(folder / DSC3D_FILE, _kept(rows))
    else:
        (folder / DSC3D_FILE).unlink(missing_ok=True)


def read_metrics_data(folder: Path) -> MetricsData:
    """Read what `write_metrics_data` wrote."""
    beside = _read(folder / DSC3D_FILE) if (folder / DSC3D_FILE).exists() else pd.DataFrame({"dataset": []})
    parts = [rows for _, rows in beside.groupby("dataset", sort=False)]
    return MetricsData(
        _read(folder / FILE), tuple(MetricsData(rows.reset_index(drop=True)) for rows in parts)
    )


def _kept(rows: pd.DataFrame) -> bytes:
    buffer = io.BytesIO()
    kept = rows.astype(dict.fromkeys(KEYS, "category") | dict.fromkeys(FIGURES, KEPT))
    kept.to_parquet(buffer, index=False, compression="zstd")
    return buffer.getvalue()


def _read(path: Path) -> pd.DataFrame:
    return frame_of(path.read_bytes()).astype(dict.fromkeys(KEYS, "str"))


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


def _sound(rows: pd.DataFrame, run: Location, dsc3d: tuple[MetricsData, ...] = ()) -> MetricsData:
    data = MetricsData(rows, dsc3d)
    if not data.tiles.complete.any():
        raise ConfigError(f"{run} has no tile with figures for every variant; see `flexroad status {run}`")
    return data
