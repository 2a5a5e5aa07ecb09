"""The paper's figures, drawn from a run: each as vector PDF and PNG, with a page of captions."""

from __future__ import annotations

from pathlib import Path

from matplotlib import rc_context

from flexroad.catalog.storage.paths import write
from flexroad.pipeline.reproduce.evidence import collect
from flexroad.pipeline.reproduce.figures import dataset, maps, profile, renders, trade_off
from flexroad.pipeline.reproduce.figures.cast import Cast, cast_of
from flexroad.pipeline.reproduce.figures.plate import STYLE, Plate, save
from flexroad.pipeline.reproduce.figures.view import TileView, typical_tile, view_tile
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.store.tables import read_metrics


def write_figures(run: Run, folder: Path, tile_id: str | None = None, cast: Cast | None = None) -> list[str]:
    """Draw every figure the run has the variants for, and ``figures.md`` with their captions.

    Parameters
    ----------
    run : Run
        A run with finished tiles.
    folder : Path
        Where NAME.pdf, NAME.png and figures.md are written.
    tile_id : str, optional
        The tile of the maps, renders and profile; by default the one of median road L2.
    cast : Cast, optional
        Which variant plays which part; by default as its options tell.

    Returns
    -------
    list of str
        One line per figure that could not be drawn, and why.

    Raises
    ------
    ConfigError
        If no tile of the run has every variant, the run mixes data, or the tile's results cannot be made
        again.
    CatalogError
        If the tile is unknown.
    """
    cast = cast or cast_of(run.config)
    evidence = collect(run)
    rows = read_metrics(run.path)
    # The tiles of the tables: those with every variant.
    done = rows[rows.tile_id.isin(evidence.tiles.index[evidence.tiles.complete])]
    with rc_context(STYLE):
        plates = _plates(run, cast, view_tile(run, tile_id or typical_tile(done, cast.full), cast), done)
        missing = [f"no figure {plate.name}: {plate.missing}" for plate in plates if plate.figure is None]
        for plate in plates:
            if plate.figure is not None:
                save(plate.figure, folder, plate.name)
    write(folder / "figures.md", _page(evidence.line, plates).encode())
    return missing


def _plates(run: Run, cast: Cast, view: TileView, done: dataset.Table) -> list[Plate]:
    return [
        profile.plate(view, cast),
        maps.plate(view, cast),
        renders.plate(view, cast),
        trade_off.plate(run.config, cast.full, done),
        dataset.plate(dataset.statistics(run, cast.full, done)),
    ]


def _page(data: str, plates: list[Plate]) -> str:
    parts = [data, "# Figures"]
    for plate in plates:
        drawn = f"![{plate.name}]({plate.name}.png)\n\n{plate.caption}"
        parts.append(drawn if plate.figure is not None else f"No figure `{plate.name}`: {plate.missing}")
    return "\n\n".join(parts) + "\n"
