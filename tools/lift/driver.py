"""Files of other programs with heights of a run: road networks, lines, polygons and points."""

from __future__ import annotations

import shlex
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import shapely

from flexroad.catalog.guard.open_vector import GEOPACKAGES, SQLITE
from flexroad.catalog.guard.source_files import SHAPEFILE_PARTS, SQLITE_PARTS, InputRejected, head
from flexroad.catalog.lazy import lazy
from flexroad.catalog.storage.outputs import made_folder, output_file
from flexroad.catalog.storage.paths import write
from flexroad.catalog.storage.scratch import ScratchFolder
from flexroad.catalog.text import count
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.finished import passing
from flexroad.pipeline.run.sampler import RunSampler, length_text
from flexroad.pipeline.store.tables import csv_text
from flexroad.tasks.errors import TaskError
from flexroad.tasks.quality.flagged import flag_names
from flexroad.tools.lift import flatgeobuf, geojson, geopackage, opendrive, osm, shapefile, sumo, xml_text
from flexroad.tools.lift.types import Frame, Lifted, Options, RunSurface, plan_crs

if TYPE_CHECKING:
    import geopandas
else:
    geopandas = lazy("geopandas")

XML_FORMATS: dict[str, ModuleType] = {"OpenDRIVE": opendrive, "net": sumo, "osm": osm}
"""Formats by the name of the outermost element."""
NOUNS: dict[ModuleType, str] = {opendrive: "road", sumo: "edge", osm: "way"}
"""Name of a row of the report; in other formats, a feature."""
VECTORS: tuple[ModuleType, ...] = (geopackage, geojson, flatgeobuf, shapefile)
"""Formats of features. Their heights have the steps beside roads."""
KINDS = (
    "OpenDRIVE (.xodr), a network of SUMO (.net.xml), OSM (.osm), a GeoPackage, GeoJSON, FlatGeobuf or "
    "Shapefile"
)
PACKED = {
    b"BZh": "is compressed with bzip2; unpack it: bunzip2 --keep {file}",
    b"OSMHeader": "is OSM's PBF; convert it: osmium cat {file} -o streets.osm",
}
"""Advice for files in formats that are not read, by their first bytes."""
DISTANCES = {"elevation_m": "", "superelevation_m": " with superelevation"}
"""Distances from the surface in the summary, and the words after them."""
PLACES = ".gpkg"
"""Places above limits are in a file next to the report, with the same name and this suffix."""


@dataclass(frozen=True)
class LiftedFile:
    """The result for a file."""

    rows: tuple[Lifted, ...]
    earlier: int
    """Number of tiles whose heights are from earlier sources or options."""
    noun: str
    """Name of a row."""
    options: Options
    tile_step_m: float = 0.0
    """Largest step between the run's tiles below the file."""

    @property
    def summary(self) -> str:
        """One line: the lengths with and without heights."""
        parts = [f"{count(len(self.rows), self.noun)}, {_length(self.rows, 'length_m')}"]
        if any(row.without_ground_m > 0 for row in self.rows):
            kept = "go on level" if self.options.beyond == "flat" else "keep their heights"
            parts.append(f"{_length(self.rows, 'without_ground_m')} beyond the tiles {kept}")
        if any(row.unknown_deck_m > 0 for row in self.rows):
            parts.append(f"{_length(self.rows, 'unknown_deck_m')} on decks or in tunnels of unknown height")
        figures = [
            f"{length_text(max(values))}{words}"
            for name, words in DISTANCES.items()
            if (values := [value for row in self.rows if np.isfinite(value := getattr(row, name))])
        ]
        if figures:
            parts.append(f"at most {', '.join(figures)} from the surface")
        return "; ".join(parts)

    @property
    def notes(self) -> tuple[str, ...]:
        """Lines for the user: the rows without heights of the run, and the reasons."""
        without = [row for row in self.rows if row.without_ground_m > 0 or row.points_without_ground]
        unknown = [row for row in self.rows if row.unknown_deck_m > 0]
        notes = []
        if without:
            length = sum(row.without_ground_m for row in without)
            points = sum(row.points_without_ground for row in without)
            parts = [f"{length:.1f} m"] if length else []
            parts += [count(points, "point")] if points else []
            kept = "go on level there" if self.options.beyond == "flat" else "keep their heights"
            notes.append(
                f"{' and '.join(parts)} of {count(len(without), self.noun)} lie beyond the finished tiles "
                f"and {kept} ({_first(without)})"
            )
        if flagged := {row.id: ", ".join(flag_names(row.flags)) for row in self.rows if row.flags}:
            notes.append(passing(flagged, self.noun))
        noted = defaultdict[str, list[Lifted]](list)
        for row in self.rows:
            noted[row.note].append(row)
        for note, rows in noted.items():
            notes += [f"{count(len(rows), self.noun)}: {note} ({_first(rows)})"] if note else []
        if unknown:
            length = sum(row.unknown_deck_m for row in unknown)
            notes.append(
                f"{length:.1f} m of {count(len(unknown), self.noun)} are on a deck of unknown height "
                f"({_first(unknown)}); a run with segment.levels=true has its level"
            )
        if self.options.crossfall_limit is not None and not any(
            np.isfinite(row.crossfall) for row in self.rows
        ):
            notes.append(
                "--crossfall-limit: crossfalls are not known for this format; only grades are listed"
            )
        return tuple(notes)


def _first(rows: Sequence[Lifted]) -> str:
    return f"{rows[0].id}{' and others' if len(rows) > 1 else ''}"


def _length(rows: Sequence[Lifted], name: str) -> str:
    """Return the sum of lengths of rows, as a text."""
    metres = float(np.nansum([getattr(row, name) for row in rows]))
    return f"{metres:.0f} m" if metres < 100 else f"{metres / 1000:.1f} km"


def lift(
    ground: RunSampler,
    source: Path,
    out: Path,
    options: Options,
    crs: str | None = None,
    offset: tuple[float, float] | None = None,
    report: Path | None = None,
) -> LiftedFile:
    """Write a file with the heights of a run.

    - `source`, `out`: the file and its copy, in the same format.
    - `crs`, `offset`: CRS of the file, and an offset added to its coordinates (m), if the file has none.
    - `report`: a CSV with a row per road or feature; places above limits are in a GeoPackage next to it.
    """
    _require_outputs(source, out, report)
    try:
        module = _format(source)
        _require_suffix(module, source, out)
        named = module.frame(source)
        place = replace(named, crs=crs or named.crs)
        if offset is not None:
            place = Frame(place.crs, *offset)
        if place.crs is None:
            raise TaskError("carries no CRS; give it with --crs, such as --crs EPSG:25832")
        in_run = RunSurface(ground, plan_crs(place.crs), place, module in VECTORS, crs is not None)
        with made_folder(out.absolute().parent), ScratchFolder(out.absolute().parent) as scratch:
            with _named(out, Path(scratch)):
                rows = tuple(module.lift(source, Path(scratch, out.name), in_run, options))
            in_run.require_heights()
            _move(Path(scratch), out)
    except (TaskError, InputRejected) as error:
        raise ConfigError(f"{source} {error}") from error
    if report is not None:
        _write_report(rows, report, in_run)
    seen = in_run.seen
    return LiftedFile(rows, len(seen.earlier), NOUNS.get(module, "feature"), options, seen.tile_step_m)


def _format(source: Path) -> ModuleType:
    """Return the module of a file's format, found by the first bytes."""
    data = head(source)
    first = data.removeprefix(b"\xef\xbb\xbf").lstrip()
    if first[:1] == b"<" or first[:2] == b"\x1f\x8b":
        name = xml_text.root_name(source)
        if name in XML_FORMATS:
            return XML_FORMATS[name]
        if name == "osmChange":
            raise TaskError("is a list of changes (osmChange); give the complete file (.osm)")
        raise TaskError(f"has the root element {name or 'none'}; give {KINDS}")
    if data.startswith(SQLITE) and data[68:72] in GEOPACKAGES:
        return geopackage
    if first[:1] == b"{":
        return geojson
    if data.startswith(b"fgb\x03"):
        return flatgeobuf
    if data.startswith(b"\0\0\x27\x0a"):
        return shapefile
    for begin, said in PACKED.items():
        if begin in data[:64]:
            raise TaskError(f"{said.format(file=shlex.quote(str(source)))}")
    raise TaskError(
        f"is of no known format; give {KINDS}; convert others, such as DXF, with ogr2ogr NEW.gpkg FILE"
    )


def _require_suffix(module: ModuleType, source: Path, out: Path) -> None:
    """Raise an error if a copy of features would have another format, or is open in another program."""
    if module not in VECTORS:
        return
    if out.suffix.lower() not in module.SUFFIXES:
        own = module.SUFFIXES[0]
        raise ConfigError(
            f"-o {out}: is of another format than {source}; write {out.stem}{own}, then "
            f"ogr2ogr {shlex.quote(out.name)} {shlex.quote(out.stem + own)}"
        )
    for end in SQLITE_PARTS if module is geopackage else ():
        part = out.with_name(out.name + end)
        if part.exists():
            raise ConfigError(
                f"-o {out}: is open in another program, as {part.name} is there; close it there"
            )


def _require_outputs(source: Path, out: Path, report: Path | None) -> None:
    """Raise an error if an output would replace the input, or another output."""
    files = [
        (out, "-o"),
        *([(report, "--report"), (report.with_suffix(PLACES), "--report")] if report else []),
    ]
    taken = {source.resolve(): str(source)}
    for path, option in files:
        if path.resolve() in taken:
            raise ConfigError(f"{option} {path}: is also {taken[path.resolve()]}; give another name")
        taken[path.resolve()] = f"{option} {path}"
        output_file(path)


@contextmanager
def _named(out: Path, scratch: Path) -> Iterator[None]:
    """Name the output in errors from the scratch folder; the error of a full disk names no file."""
    try:
        yield
    except OSError as error:
        if error.filename is not None and scratch not in Path(error.filename).parents:
            raise
        raise OSError(error.errno, error.strerror or str(error), str(out)) from error


def _move(scratch: Path, out: Path) -> None:
    """Move the files that a format has written to their places; the requested file is the last.

    Parts of a replaced Shapefile that the new Shapefile lacks are removed, such as old indices.
    """
    made = sorted(path for path in scratch.iterdir() if path.is_file() and not path.name.startswith("."))
    made.sort(key=lambda path: path.name == out.name)
    for path in made:
        path.replace(output_file(out.parent / path.name))
    if out.suffix.lower() == shapefile.SUFFIXES[0]:
        names = {path.name for path in made}
        for end in SHAPEFILE_PARTS:
            part = out.with_suffix(end)
            if part.name not in names and part.is_file():
                part.unlink()


def _write_report(rows: Sequence[Lifted], report: Path, in_run: RunSurface) -> None:
    """Write the table, and the places above limits, if any."""
    table = pd.DataFrame(map(_row, rows), columns=list(_row(Lifted(""))), dtype=object)
    write(report, csv_text(table).encode())
    steep = [(row.id, place) for row in rows for place in row.steep]
    if not steep:
        return
    east, north = in_run.to_run(
        np.array([place.x for _, place in steep]), np.array([place.y for _, place in steep])
    )
    found, _ = in_run.ground.heights(east, north)
    columns = {
        "id": [name for name, _ in steep],
        "kind": [place.kind for _, place in steep],
        "percent": [round(100 * place.value, 3) for _, place in steep],
    }
    height = np.nan_to_num(found.ground)
    frame = geopandas.GeoDataFrame(columns, geometry=shapely.points(east, north, height), crs=in_run.run_crs)
    with ScratchFolder() as folder:
        frame.to_file(Path(folder, "places.gpkg"), layer="places", driver="GPKG", engine="pyogrio")
        write(report.with_suffix(PLACES), Path(folder, "places.gpkg").read_bytes())


def _row(row: Lifted) -> dict[str, str | int | float]:
    """Return a row of the report: lengths in m, heights in mm, slopes in percent; empty where unknown."""
    figures = {
        "length_m": (row.length_m, 1, 3),
        "without_ground_m": (row.without_ground_m, 1, 3),
        "unknown_deck_m": (row.unknown_deck_m, 1, 3),
        "before_max_mm": (row.before_m, 1000, 1),
        "elevation_max_mm": (row.elevation_m, 1000, 1),
        "superelevation_max_mm": (row.superelevation_m, 1000, 1),
        "grade_max_percent": (row.grade, 100, 3),
        "crossfall_max_percent": (row.crossfall, 100, 3),
        "error_estimate_mm": (row.error_m, 1000, 1),
    }
    values: dict[str, str | int | float] = {"id": row.id, "levels": " ".join(map(str, row.levels))}
    values["points_without_ground"] = row.points_without_ground
    for name, (value, factor, digits) in figures.items():
        values[name] = round(value * factor, digits) if np.isfinite(value) else ""
    return {**values, "flags": ", ".join(flag_names(row.flags)), "note": row.note}
