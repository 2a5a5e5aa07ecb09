"""The metrics that a comparison with the paper uses: figures of every tile and variant, and their dataset."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import pandas as pd

from flexroad.catalog.storage.paths import Location, write
from flexroad.catalog.text import count, printable
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.store.tables import read_metrics
from flexroad.tools.report.content import FIGURES

FILE, DSC3D_FILE = "metrics.parquet", "metrics_dsc3d.parquet"
LITERAL_FILE, DSM_FILE = "metrics_literal.parquet", "metrics_dsm.parquet"
KEYS = ["dataset", "classes", "tile_id", "stratum", "variant"]
FIGURE_DTYPE: Final = "float32"
"""Type of the stored figures. Pages are made from these values: the stored files reproduce them exactly."""
PARTLY = "partly reference"
"""Value of the column ``classes`` if only some tiles have a true mask."""
UNNAMED = "rasters whose catalog does not name them"


@dataclass(frozen=True, eq=False)
class MetricsData:
    """The rows of one run, or of two runs that differ in `evaluate.classes`, and of the runs for DSC3D."""

    rows: pd.DataFrame
    """Columns `KEYS` and `FIGURES`, one row per classes, tile and variant; NaN for failed tiles."""
    dsc3d: tuple[MetricsData, ...] = ()
    """Runs for the DSC3D rows, one per reference; the reference that the paper describes comes first."""
    literal: MetricsData | None = None
    """A run with the paper read literally over all or some of the tiles; None without such a run."""
    dsm: MetricsData | None = None
    """The same tiles measured against the DSM; None without such a run."""

    @property
    def dataset(self) -> str:
        """Name of the dataset."""
        return str(self.rows.dataset.iloc[0])

    @property
    def classes(self) -> tuple[str, ...]:
        """The masks that classed the cells: ``segmented``, ``reference`` or `PARTLY`; the main one first."""
        return tuple(dict.fromkeys(self.rows.classes))

    @property
    def tiles(self) -> pd.DataFrame:
        """Columns ``stratum`` and ``complete`` (no variant failed), by tile id."""
        groups = self.rows.groupby("tile_id", sort=True)
        complete = groups.triangles.agg(lambda counts: bool(counts.notna().all()))
        return pd.DataFrame({"stratum": groups.stratum.first(), "complete": complete})

    @property
    def line(self) -> str:
        """The dataset and its number of tiles, in one line."""
        done = self.tiles[self.tiles.complete]
        strata = done.stratum[done.stratum != ""].value_counts()
        parts = f" ({', '.join(f'{n} {name}' for name, n in strata.items())})" if len(strata) else ""
        failed = len(self.tiles) - len(done)
        left_out = f"; {count(failed, 'failed tile')} left out" if failed else ""
        return printable(f"Data: {self.dataset}, {count(len(done), 'tile')}{parts}{left_out}{self._roads}.")

    @property
    def _roads(self) -> str:
        """The number of tiles without figures of roads, as a part of a sentence; empty if it is 0."""
        figures = self.part(self.classes[0]).l2_road_m.unstack()
        without = int(figures.isna().any(axis=1).sum())
        return f"; {without} without roads, left out of the figures of roads" if without else ""

    def part(self, classes: str) -> pd.DataFrame:
        """Return the figures of the complete tiles, one row per ``(tile_id, variant)``."""
        complete = self.tiles.index[self.tiles.complete]
        rows = self.rows[(self.rows.classes == classes) & self.rows.tile_id.isin(complete)]
        return rows.set_index(["tile_id", "variant"])[list(FIGURES)].astype("float64").sort_index()


def collect(
    run: Run,
    true: Run | None = None,
    dsc3d: Run | None = None,
    dsc3d_true: Run | None = None,
    literal: Run | None = None,
    dsm: Run | None = None,
) -> MetricsData:
    """Return the figures of a run and of the runs it is compared with.

    - `run`: the main run.
    - `true`: the same tiles, classed by the true road mask.
    - `dsc3d`: scenes of DSC3D or synthetic scenes instead, measured against the reference that the paper
      describes.
    - `dsc3d_true`: the same scenes, measured against the true surface.
    - `literal`: a run with configs/literal.yaml over the same tiles or some of them.
    - `dsm`: the same tiles and variants with configs/ablation_dsm.yaml: measured against the DSM.
    """
    if dsc3d is None and dsc3d_true is not None:
        raise ConfigError(f"--dsc3d-true {dsc3d_true.path} needs --dsc3d: give that run, too")
    scenes = tuple(_checked(_rows(other), other.path) for other in (dsc3d, dsc3d_true) if other is not None)
    if dsc3d and dsc3d_true:
        _check_twins(dsc3d, dsc3d_true, *(data.rows for data in scenes))
    first = _rows(run)
    column = _checked_literal(literal, first) if literal else None
    other = _checked_dsm(dsm, run, first) if dsm else None
    if true is None:
        return _checked(first, run.path, scenes, column, other)
    second = _rows(true)
    if not any(tile.layer("reference_road") for tile in true.catalog.tiles):
        raise ConfigError(f"{true.path} has no true road mask in its catalog; leave out --true")
    if set(first.classes) & set(second.classes):
        raise ConfigError(
            f"{run.path} and {true.path} both class by the {first.classes.iloc[0]} mask; "
            "--true needs a run with evaluate.classes: reference"
        )
    _check_same(run, first, true, second)
    return _checked(pd.concat([first, second], ignore_index=True), run.path, scenes, column, other)


def _checked_literal(literal: Run, first: pd.DataFrame) -> MetricsData:
    rows = _rows(literal)
    if {*rows.dataset} != {*first.dataset} or not {*rows.tile_id} <= {*first.tile_id}:
        raise ConfigError(
            f"{literal.path} has other data or tiles than the main run; --literal needs its catalog"
        )
    return _checked(rows, literal.path)


def _checked_dsm(dsm: Run, run: Run, first: pd.DataFrame) -> MetricsData:
    if any(chain["evaluate"].truth != "dsm" for chain in dsm.config.chains.values()):
        raise ConfigError(f"{dsm.path} is not measured against the DSM; --dsm needs --config ablation_dsm")
    rows = _rows(dsm)
    _check_same(run, first, dsm, rows)
    return _checked(rows, dsm.path)


def _check_same(run: Run, first: pd.DataFrame, other: Run, second: pd.DataFrame) -> None:
    if _tile_variants(first) != _tile_variants(second) or {*first.dataset} != {*second.dataset}:
        raise ConfigError(
            f"{other.path} has other data, tiles or variants than {run.path}; run both over the same catalog"
        )


def _check_twins(run: Run, true: Run, first: pd.DataFrame, second: pd.DataFrame) -> None:
    if _tile_variants(first) != _tile_variants(second):
        raise ConfigError(
            f"{true.path} has other tiles or variants than {run.path}; "
            "--dsc3d-true needs the same scenes with the true reference"
        )
    if {*first.dataset} == {*second.dataset}:
        raise ConfigError(
            f"{true.path} has the same data as {run.path}: {first.dataset.iloc[0]}; "
            "--dsc3d-true needs the same scenes with the true reference"
        )


def _tile_variants(rows: pd.DataFrame) -> set[tuple[str, str]]:
    return {*zip(rows.tile_id, rows.variant, strict=True)}


def write_metrics_data(data: MetricsData, folder: Path) -> None:
    """Write the figures, one file for each kind of run; files of other kinds are removed."""
    kinds = {
        FILE: (data,),
        DSC3D_FILE: data.dsc3d,
        LITERAL_FILE: (data.literal,) if data.literal else (),
        DSM_FILE: (data.dsm,) if data.dsm else (),
    }
    for name, runs in kinds.items():
        if runs:
            write(folder / name, _parquet(pd.concat([run.rows for run in runs], ignore_index=True)))
        else:
            (folder / name).unlink(missing_ok=True)


def _parquet(rows: pd.DataFrame) -> bytes:
    buffer = io.BytesIO()
    table = rows.astype(dict.fromkeys(KEYS, "category") | dict.fromkeys(FIGURES, FIGURE_DTYPE))
    table.to_parquet(buffer, index=False, compression="zstd")
    return buffer.getvalue()


def _rows(run: Run) -> pd.DataFrame:
    datasets = sorted({tile.dataset for tile in run.catalog.tiles})
    if len(datasets) > 1:
        raise ConfigError(
            f"{run.path} mixes datasets: {', '.join(name or 'unnamed' for name in datasets)}; "
            "run each of them separately"
        )
    classes = sorted({chain["evaluate"].classes for chain in run.config.chains.values()})
    if len(classes) > 1:
        raise ConfigError(f"{run.path}: evaluate.classes differs between variants; use one value for all")
    rows = read_metrics(run.path)
    rows = rows.assign(dataset=datasets[0] or UNNAMED, classes=_classes_used(run, classes[0], rows))
    figures = rows[list(FIGURES)].astype("float64").where(rows.status == "done").astype(FIGURE_DTYPE)
    return pd.concat([rows[KEYS].astype("str"), figures], axis="columns")


def _classes_used(run: Run, option: str, rows: pd.DataFrame) -> str:
    """Return the mask that classed the cells; without a true mask it is always the segmented mask."""
    done = set(rows.tile_id[rows.status == "done"])
    tiles = [tile for tile in run.catalog.tiles if tile.id in done or not done]
    with_mask = sum(tile.layer("reference_road") is not None for tile in tiles)
    if option == "segmented" or not with_mask:
        return "segmented"
    return "reference" if with_mask == len(tiles) else PARTLY


def _checked(
    rows: pd.DataFrame,
    run: Location,
    dsc3d: tuple[MetricsData, ...] = (),
    literal: MetricsData | None = None,
    dsm: MetricsData | None = None,
) -> MetricsData:
    data = MetricsData(rows, dsc3d, literal, dsm)
    if not data.tiles.complete.any():
        raise ConfigError(f"{run} has no tile with figures for every variant; see `flexroad status {run}`")
    return data
