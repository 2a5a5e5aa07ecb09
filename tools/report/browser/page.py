"""The page, from its parts: outcome, map, figures and the tiles to look at."""

from __future__ import annotations

import base64
import hashlib
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pandas as pd
from markupsafe import Markup

from flexroad.catalog.lazy import lazy
from flexroad.catalog.text import count, printable
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.status import Track, untracked
from flexroad.pipeline.store.tables import LABELS
from flexroad.tasks.quality.assess import FLAGS, LIMITS
from flexroad.tools.report.browser.figures import Comparison, compare, histograms
from flexroad.tools.report.browser.outcome import cards, described, headline, reasons, statements
from flexroad.tools.report.browser.tiles import (
    TileTable,
    as_script,
    errors,
    map_data,
    numeric_columns,
    tile_table,
)
from flexroad.tools.report.content import ESTIMATE_MEANING, MAIN, WORST, WORST_ESTIMATES, Content
from flexroad.tools.report.pages import TilePictures, sections, template
from flexroad.tools.report.pictures import relief, tile_pictures

pyproj = lazy("pyproj")

HERE = Path(__file__).parent
SCRIPT = HERE.resolve().parents[2] / "viewer" / "dist" / "report" / "page.js"
"""Built from viewer/src/report. Folders of a checkout's package are links, which resolve() follows."""
NAMED = 5
"""Tiles without a position that are named."""
ESTIMATE, TRUE_ERROR = "error_estimate_m", "l2_road_m"


def html_page(
    run: Run,
    content: Content,
    viewer: str = "",
    before: tuple[str, pd.DataFrame] | None = None,
    track: Track = untracked,
) -> str:
    """Return the report as one self-contained HTML page.

    - `viewer`: address of the page of the 3D viewer, relative to the report; empty without one.
    - `before`: name and rows of another run over the same tiles, for a comparison.
    """
    table, failed = tile_table(run.catalog.tiles, content), errors(content)
    ranked_by, first = ranking(table)
    pictures = {tile.tile_id: tile for tile in tile_pictures(run, content, first, track)}
    comparison = compare(table, before[1], content.variant, before[0]) if before else None
    numbers = {tile.id: i for i, tile in enumerate(table.tiles)}
    background = relief(run, table.finished, content.results, track)
    data = _data(table, failed, pictures, viewer, comparison)
    if background:
        places = [background.places.get(tile.id) for tile in table.tiles]
        data["relief"] = {"side": background.side_px, "columns": background.columns, "places": places}
    script = SCRIPT.read_text(encoding="utf-8")
    return template("page.html.j2", HERE).render(
        content=content,
        main=content.tables[MAIN][0],
        style=Markup((HERE / "page.css").read_text(encoding="utf-8")),
        script=Markup(script),
        script_hash=f"sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}",
        data=Markup(as_script(data)),
        headline=headline(table, content.counts.skipped),
        cards=cards(table),
        statements=statements(content, table, failed, str(run.path)),
        crs=_crs_name(table.crs),
        unplaced=_unplaced(table),
        relief=background.webp if background else None,
        charts=list(histograms(numeric_columns(table), _limits())),
        comparison=comparison,
        looks=[_look(name, table, numbers[name], pictures.get(name), viewer) for name in first],
        ranked_by=ranked_by,
        meaning=ESTIMATE_MEANING.replace("`", ""),
        viewer=viewer,
        view_command=f"flexroad view {shlex.quote(str(run.path))}",
        sections=[one for one in sections(content) if one[0] not in (MAIN, WORST_ESTIMATES)],
        tiles=[(numbers[name], tile) for name, tile in pictures.items() if name not in first],
    )  # fmt: skip


def ranking(table: TileTable) -> tuple[str, list[str]]:
    """Return the name of the ranking, and the ids of the worst tiles, the worst first."""
    for column, words in (
        (ESTIMATE, "with the highest error estimate, highest first"),
        (TRUE_ERROR, "with the highest road error (L2), highest first"),
    ):
        values = pd.to_numeric(table.frame[column], errors="coerce").dropna()
        if len(values):
            # Among equal values, the first in the catalog.
            return words, [
                str(name) for name in values.sort_values(ascending=False, kind="stable").index[:WORST]
            ]
    return "", []


def _data(
    table: TileTable,
    failed: dict[str, str],
    pictures: Mapping[str, TilePictures],
    viewer: str,
    comparison: Comparison | None,
) -> dict[str, Any]:
    data = map_data(table, failed, {} if comparison is None else comparison.columns)
    limits = _limits()
    for column in data["columns"]:
        column["limit"] = limits.get(column["key"])
    data["meanings"] = {flag: one for flag, one in described().items() if flag in data["flagNames"]}
    data["viewer"] = viewer
    data["places"] = {
        i: {flag: [round(float(value), 2) for value in place] for flag, place in found.places.items()}
        for i, tile in enumerate(table.tiles)
        if (found := pictures.get(tile.id)) and found.places
    }
    return data


def _limits() -> dict[str, float]:
    """Return the thresholds of the flags by column, in the unit of the page."""
    return {name: LIMITS[flag] * (100 if LABELS[name][1] == "%" else 1) for flag, name in FLAGS.items()}


def _look(
    name: str,
    table: TileTable,
    number: int,
    found: TilePictures | None,
    viewer: str,
) -> dict[str, Any]:
    """Return the content of the page on a tile to look at."""
    row: dict[str, Any] = dict(table.frame.loc[name])
    estimate, true = row[ESTIMATE], row[TRUE_ERROR]
    parts = [f"Error estimate {estimate:.2g} m"] if np.isfinite(estimate) else []
    parts += [f"road error (L2) {true:.2g} m"] if np.isfinite(true) else []
    pictures = found.pictures if found else ()
    return {
        "tile_id": name,
        "number": number,
        "figure": f"{'; '.join(parts)}.",
        "reasons": reasons(row, found.places if found else {}, found.notes if found else ()),
        # The first and the last picture show most.
        "pair": tuple(dict.fromkeys((*pictures[:1], *pictures[-1:]))),
        "more": pictures[1:-1],
        "notes": found.notes if found else (),
        "view": f"{viewer}#tile={quote(name, safe='')}" if viewer else "",
    }


def _crs_name(crs: str) -> str:
    """Return code and name of a CRS for the line below the map."""
    try:
        name = pyproj.CRS.from_user_input(crs).name
    except pyproj.exceptions.CRSError:
        return printable(crs)
    return printable(f"{crs} ({name})" if len(crs) < 20 else name)


def _unplaced(table: TileTable) -> str:
    missing = [tile.id for tile, box in zip(table.tiles, table.bounds, strict=True) if np.isnan(box[0])]
    if not missing:
        return ""
    more = f" and {len(missing) - NAMED} more" if len(missing) > NAMED else ""
    names = f"{', '.join(missing[:NAMED])}{more}"
    return f"Not on the map, because their position is not known: {count(len(missing), 'tile')}: {names}."
