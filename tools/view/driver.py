"""A run as a folder that a browser opens without a server: page, scripts, and one script per tile.

An earlier page is removed first, and the page is written last: so a folder with a page is complete.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np

from flexroad.catalog import Bounds, Tile
from flexroad.catalog.crs import in_plan, name, short, transformer
from flexroad.catalog.ids import safe_name
from flexroad.catalog.lazy import lazy
from flexroad.catalog.storage.paths import Location, absolute, contained, exists, read, remove, write
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.run.finished import FinishedTile, RunPlace, snapshots
from flexroad.pipeline.run.record import Run, check_links, check_own
from flexroad.pipeline.run.status import Track, ended, peek_statuses, untracked
from flexroad.pipeline.store.records import LEVELS
from flexroad.pipeline.store.tables import LABELS
from flexroad.pipeline.worker.exports import tile_photo
from flexroad.tasks.errors import TaskError
from flexroad.tasks.io.dsm_and_dtm import vertical_crs
from flexroad.tasks.load import layer_source
from flexroad.tasks.meshing.normals import mesh_normals
from flexroad.tasks.products import glb
from flexroad.tasks.quality.height_source import top_height_source
from flexroad.tasks.roads import rasterise
from flexroad.tasks.roads.rasterise import Options as RoadOptions
from flexroad.tasks.roads.routes import CentreLine
from flexroad.tasks.spline.surface import NurbsSurface
from flexroad.tools.export.network import read_centre_lines
from flexroad.tools.export.source import layer_state
from flexroad.tools.export.tile_outputs import TileOutput, write_outputs
from flexroad.tools.view import encoding

shapely = lazy("shapely")

VERSION = 100 * encoding.VERSION + glb.VERSION
PAGE = "index.html"
OWNER = ".flexroad-viewer"
"""File with the path of the run whose viewer the folder has."""
PENDING, DONE, FAILED = range(3)
"""States of tiles in the index."""
MEASURES = """
    error_estimate_m worst_error_estimate_m max_unexplained_area_m2 measured_road dtm_road inferred_road
    residual_p95_m edge_step_m l2_road_m l2_terrain_m triangles seconds
""".split()
"""The columns of metrics.parquet that colour the map."""
DIGITS = 4
"""Digits of the figures in the index."""
LOOPBACK = "127.0.0.1"
NAMES = (LOOPBACK, "localhost")
WGS84 = "EPSG:4326"
QUALITY = 82
"""Quality of the photos' JPEG."""
PHOTO_PX = 1024
"""Largest width and height of a tile's photo (pixels): a tile of 250 m takes 0.3 to 0.8 MB."""
SIMPLIFIED_M = 0.05
"""Largest distance of a simplified road line from the original line (m)."""


@dataclass(frozen=True)
class _Written:
    """The result of writing a viewer."""

    page: Location
    tiles: int
    """Number of tiles with a script."""
    others: int
    """Number of tiles on the map without a surface."""
    notes: tuple[str, ...]
    """Notes on data that tiles lack, one line per tile."""


def write_viewer(
    run: Run,
    out: Location,
    executor: Executor,
    ids: Sequence[str] = (),
    bbox: Bounds | None = None,
    track: Track = untracked,
) -> _Written:
    """Write the viewer of a run, or of the selected tiles, into a folder."""
    tiles = shown_tiles(run, ids, bbox)
    variant = run.config.export.variants[0]
    _claim(out, run)
    index, done = _index(run, tiles, variant)
    options = run.config.chains[variant]["segment"]
    roads = options if isinstance(options, rasterise.Options) else rasterise.DEFAULTS
    place = RunPlace.of(run)
    finished = (
        FinishedTile(tile, variant, snapshot, place)
        for tile, snapshot in snapshots(run, done, variant)
        if snapshot
    )
    tracked, look = track(finished, "writing tiles", len(done)), (run.origin, roads)
    with ended(tracked):
        rows = list(write_outputs(tracked, out, VERSION, script, look, executor, made_of=_made_of))
    for file in built_files():
        if file.name != PAGE:
            write(out / file.name, file.read_bytes())
    # In the order of the catalog, so that equal viewers have equal bytes.
    places = {row["tile"]: row["places"] for row in rows}
    index["tiles"]["places"] = [places.get(tile.id, {}) for tile in tiles]
    found = {row["tile"]: row["picture"] for row in rows if row["picture"]}
    pictures = {tile.id: found[tile.id] for tile in done if tile.id in found}
    write(out / encoding.NAME_PICTURES, encoding.encode_pictures(pictures))
    write(out / encoding.NAME_RUN, encoding.encode_run(index | {"pictures": bool(pictures)}))
    write(out / PAGE, (_built() / PAGE).read_bytes())
    notes = tuple(f"tile {row['tile']}: {note}" for row in rows for note in row["notes"])
    return _Written(out / PAGE, len(done), len(tiles) - len(done), notes)


def shown_tiles(run: Run, ids: Sequence[str], bbox: Bounds | None) -> tuple[Tile, ...]:
    """Return the tiles of the map."""
    tiles = tuple(tile for tile in run.catalog.select(ids, bbox).tiles if not tile.fault)
    if not tiles:
        raise ConfigError(
            f"{run.path}: no selected tile has a usable entry in the catalog; see `flexroad status`"
        )
    systems = {tile.grid.crs for tile in tiles}
    if len(systems) > 1:
        raise ConfigError(f"{run.path} has tiles in {len(systems)} CRSs; select tiles of one CRS with --bbox")
    return tiles


def built_files() -> list[Path]:
    """Return the files that each viewer has: page, style, script and licences."""
    return sorted(path for path in _built().iterdir() if path.is_file())


def _built() -> Path:
    # In a checkout the package's folders are links. resolve() follows them to the root with viewer/.
    return Path(__file__).resolve().parents[2] / "viewer" / "dist"


def _claim(out: Location, run: Run) -> None:
    """Take the folder for this run's viewer: remove an earlier page, and store the run's path."""
    for place in (run.path, run.store, run.path / "tiles"):
        if absolute(out) == absolute(place) or absolute(out) in absolute(place).parents:
            raise ConfigError(f"{out} is a folder of the run or above it; choose another folder with -o")
    for place in (run.store, run.path / "tiles"):
        if absolute(place) in absolute(out).parents:
            raise ConfigError(f"{out} lies in {place}, which belongs to the run; choose another with -o")
    if isinstance(out, Path) and out.is_file():
        raise ConfigError(f"{out} is a file; choose a folder with -o")
    owner = read(out / OWNER).decode(errors="replace") if exists(out / OWNER) else ""
    own = str(absolute(run.path))
    # A folder inside the run may have been moved with it.
    if owner and owner != own and absolute(run.path) not in absolute(out).parents:
        raise ConfigError(f"{out} has the viewer of {owner}; choose another folder with -o, or remove it")
    check_own(out, lambda: bool(owner), "a viewer", "-o")
    check_links(out, below=True)
    write(out / OWNER, own.encode())
    remove(out / PAGE)


def _made_of(tile: FinishedTile) -> str:
    """Return the hash of the input of a tile's script."""
    photo_and_lines = (layer_state(tile.tile, name) for name in ("dop", "roads"))
    return " ".join((tile.snapshot.nodes["assess"], *photo_and_lines))


def _index(run: Run, tiles: Sequence[Tile], variant: str) -> tuple[dict[str, Any], list[Tile]]:
    """Return the index of the run, and its finished tiles."""
    states, rows, errors, stale = list[int](), list[dict[str, Any]](), list[str](), list[bool]()
    for status in peek_statuses(run, tiles):
        states.append(DONE if status.done else FAILED if status.failed else PENDING)
        record = status.last_record
        figures = record.rows if status.done and record else ()
        rows.append(next((row for row in figures if row.get("variant") == variant), {}))
        failures = record.failures if status.failed and record else ()
        lines = dict.fromkeys(f"{f.line}{f' [{f.file}]' if f.file else ''}" for f in failures)
        errors.append("; ".join(lines))
        stale.append(status.stale)
    bounds = [tile.grid.bounds for tile in tiles]
    measures = {name: [_figure(row.get(name)) for row in rows] for name in MEASURES}
    known = {name: values for name, values in measures.items() if any(value is not None for value in values)}
    columns = {
        "id": [tile.id for tile in tiles],
        "file": [safe_name(tile.id) for tile in tiles],
        "west": [west for west, _, _, _ in bounds],
        "south": [south for _, south, _, _ in bounds],
        "width": [east - west for west, _, east, _ in bounds],
        "height": [north - south for _, south, _, north in bounds],
        "state": states,
        "stale": stale,
        "flags": [[flag for flag in (row.get("flags") or "").split(", ") if flag] for row in rows],
        "error": errors,
        "measures": known,
    }
    crs, vertical = tiles[0].grid.crs, vertical_crs(tiles[0])
    label = short(crs)
    index = {
        "name": run.path.name or "run",
        "variant": variant,
        "crs_name": label if label == name(in_plan(crs)) else f"{label}, {name(in_plan(crs))}",
        "vertical": name(vertical) if vertical else None,
        "origin": list(run.origin),
        "measures": {key: _titled(*LABELS[key]) for key in known},
        "tiles": columns,
    } | ({"levels": True} if any(LEVELS in row for row in rows) else {})
    return index, [tile for tile, state in zip(tiles, states, strict=True) if state == DONE]


def _titled(label: str, unit: str) -> dict[str, str]:
    return {"title": label[0].upper() + label[1:], "unit": unit}


def _figure(value: Any) -> float | None:
    if value is None or not math.isfinite(value):
        return None
    return float(f"{value:.{DIGITS}g}")


class _Files(SimpleHTTPRequestHandler):
    """Files of a folder, only for requests that name this computer as host."""

    def send_head(self) -> Any:
        # Else a web page could read the folder by a host name that points to this computer.
        host = self.headers.get("Host", "").rpartition(":")[0]
        if host not in NAMES:
            self.send_error(403)
            return None
        try:
            contained(Path(self.translate_path(self.path)), Path(self.directory))
        except (OSError, ValueError):
            # A link out of the folder, or an invalid file name, such as /%00.
            self.send_error(404)
            return None
        return super().send_head()

    def list_directory(self, path: Any) -> Any:
        self.send_error(404)

    def end_headers(self) -> None:
        # The folder may be written again while it is served.
        self.send_header("Cache-Control", "no-cache")
        super().end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        pass


def server(folder: Path, port: int) -> ThreadingHTTPServer:
    """Return a server of a folder on this computer's loopback address.

    - `port`: 0 for any free port.
    """
    return ThreadingHTTPServer((LOOPBACK, port), partial(_Files, directory=str(folder)))


def script(tile: FinishedTile, look: tuple[tuple[float, float], RoadOptions]) -> TileOutput:
    """Return the script of a tile; its row has its picture, the places of its flags, and notes.

    - `look`: the run's origin (easting, northing), and the options of the road lines.
    """
    (origin, roads), source, notes = look, tile.tile, list[str]()
    photo = _photo(source, PHOTO_PX, notes)
    quality, surface, core = tile.quality, tile.surface, source.grid
    west, south, east, north = core.bounds
    to_degrees = transformer(core.crs, WGS84).transform
    corners = to_degrees([west, east, west, east], [south, south, north, north])
    top = surface.top(*np.meshgrid(core.eastings, core.northings))
    try:
        data, (estimate, _) = tile.data, tile.top_errors
    except ConfigError as error:
        dsm = dtm = estimate = None
        seen, places = "", {}
        notes.append(f"no scan and terrain model to compare with: {error}")
    else:
        window = data.grid.window(data.core)
        dsm, dtm = data.dsm[window], data.dtm[window]
        height = surface.highest.lattice(core.eastings, core.northings)
        height[tile.road.outside[window]] = np.nan
        road = tile.road.mask[window] | (top > 0)
        places = {flag: list(place) for flag, place in tile.flag_places.items()}
        small = encoding.picture(height, road, data.core.cell)
        seen = base64.b64encode(small).decode("ascii")
    encoded = encoding.encode_tile(
        tile.id,
        glb.encode(tile.mesh, (*origin, 0.0), photo, mesh_normals(tile.mesh, surface)),
        source.grid,
        np.column_stack(corners),
        top_height_source(quality, top),
        dsm,
        dtm,
        estimate,
        surface if isinstance(surface, NurbsSurface) and not surface.levels else None,
        surface.highest.lattice(core.eastings, core.northings) if surface.levels else None,
        _lines(source, roads, notes),
    )
    name = f"tiles/{safe_name(tile.id)}{encoding.NAME_TILE}"
    return TileOutput(
        {name: encoded},
        {"tile": tile.id, "notes": notes, "picture": seen, "places": places},
    )


def _photo(tile: Tile, largest_px: int, notes: list[str]) -> glb.Texture | None:
    layer = tile.layer("dop")
    layer = layer and layer.reaching(tile.grid.bounds)
    if not layer:
        return None
    try:
        photo = tile_photo(tile, layer, largest_px)
    except TaskError as error:
        notes.append(f"no photo: {error}")
        return None
    return glb.texture(photo, QUALITY) if photo else None


def _lines(tile: Tile, options: RoadOptions, notes: list[str]) -> tuple[CentreLine, ...]:
    """Return the centre lines of the catalog on a tile, cut at its edges."""
    layer = tile.layer("roads")
    source = layer and layer_source(replace(tile, layers=(layer,)), layer.name)
    if not source:
        return ()
    bounds = tile.grid.bounds
    try:
        lines = read_centre_lines({source: bounds}, tile.grid.crs, options).lines
    except TaskError as error:
        notes.append(f"no road lines: {error}")
        return ()
    parts = []
    for line in lines:
        cut = shapely.LineString(line.points).simplify(SIMPLIFIED_M).intersection(shapely.box(*bounds))
        for part in shapely.get_parts(cut):
            if part.geom_type == "LineString" and part.length > 0:
                parts.append(replace(line, points=shapely.get_coordinates(part)))
    return tuple(parts)
