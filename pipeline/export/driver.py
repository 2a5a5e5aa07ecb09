"""Write exports of a run in several formats, and the manifest that says what they are."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from difflib import get_close_matches
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any

from flexroad.catalog.storage.paths import Location, read, write
from flexroad.catalog.text import count
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.export.formats import FORMATS, Format
from flexroad.pipeline.export.options import Options
from flexroad.pipeline.export.output import MANIFEST, file_sizes, held, remove_unfinished
from flexroad.pipeline.export.photo import check_photos
from flexroad.pipeline.export.source import Source
from flexroad.pipeline.run.status import Track, untracked
from flexroad.tasks.errors import TaskError

SAME = ("variant", "crs", "tiles", "results")
"""Entries of the manifest that two exports into one folder have in common if both are of the same results."""
DATUM_REMEDY = (
    "needs heights above the ellipsoid of WGS 84, and the heights of a run are above a vertical datum; say "
    "which: --vertical EPSG:N (PROJ needs its grid), --geoid FILE (.gtx or .tif), or --height-offset METRES"
)


def export(
    source: Source,
    out: Location,
    formats: Sequence[str],
    options: Options,
    executor: Executor,
    track: Track = untracked,
    notify: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """Write the formats, each into a folder of its name, and the manifest last; return the manifest.

    Parameters
    ----------
    track : callable
        Shows the progress: takes the tiles of a format, its name and their number.
    notify : callable
        Receives one line about what the user may not expect.

    Raises
    ------
    ConfigError
        If a format is unknown, needs a datum or centre lines, no tile has the photo that is wanted, a tile's
        results cannot be read, or the folder is in use.
    ClusterLost
        If the workers are gone; the same command goes on.
    OSError
        If a file cannot be written.
    """
    chosen = check_formats(formats, options)
    options = replace(options, formats=frozenset(chosen))
    if options.drape:
        check_photos(source.tiles)
    for kind in chosen.values():
        if kind.check:
            kind.check(source, options)
    with held(out, source.run, chosen, notify):
        written = _earlier(out, source, options, chosen, notify)
        for name, kind in chosen.items():
            written[name] = _written(source, out / name, name, kind, options, executor, track, notify)
        manifest = _head(source, options) | {"formats": written}
        write(out / MANIFEST, json.dumps(manifest, indent=1, allow_nan=False).encode())
    return manifest


def _written(
    source: Source,
    folder: Location,
    name: str,
    kind: Format,
    options: Options,
    executor: Executor,
    track: Track,
    notify: Callable[[str], None],
) -> dict[str, Any]:
    """Write one format; return its entry in the manifest."""
    remove_unfinished(folder, below=True)
    before = file_sizes(folder)
    if isinstance(folder, Path):
        folder.mkdir(parents=True, exist_ok=True)
    tiles = track(source.finished(), f"writing {name}", len(source.tiles))
    try:
        more = kind.write(source, tiles, folder, options, executor) or {}
    except TaskError as error:
        raise ConfigError(f"{name}: {error}") from error
    files = file_sizes(folder)
    if removed := len(before.keys() - files.keys()):
        notify(f"removed {count(removed, 'file')} of an earlier export from {folder}")
    return {
        "title": kind.title,
        "version": kind.version,
        "precision_m": kind.precision_m,
        "files": len(files),
        "bytes": sum(files.values()),
        **({"datum": options.datum.text} if kind.needs_datum and options.datum else {}),
        "notes": [],
        **more,
    }


def _head(source: Source, options: Options) -> dict[str, Any]:
    """Return the entries of the manifest that all formats share."""
    results = sha256("".join(f"{snapshot.nodes['sample']}\n" for snapshot in source.snapshots).encode())
    return {
        "flexroad": version("flexroad"),
        "run": str(source.run.path),
        "variant": source.variant,
        "crs": source.crs,
        "vertical_crs": source.vertical,
        "datum": options.datum.text if options.datum else None,
        "tiles": len(source.tiles),
        "left_out": list(source.left_out),
        "results": results.hexdigest()[:32],
    }


def _earlier(
    out: Location, source: Source, options: Options, chosen: Collection[str], notify: Callable[[str], None]
) -> dict[str, Any]:
    """Return what the manifest says of other formats in the folder, if they are of the same results."""
    try:
        manifest = json.loads(read(out / MANIFEST))
        others = {name: dict(entry) for name, entry in manifest["formats"].items() if name not in chosen}
        present = {name: entry for name, entry in others.items() if file_sizes(out / name)}
        head = _head(source, options)
        if all(manifest[name] == head[name] for name in SAME):
            return present
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}
    for name in present:
        notify(f"{out / name} is of an earlier export with other results; write it again, or remove it")
    return {}


def check_formats(names: Sequence[str], options: Options) -> dict[str, Format]:
    """Return the formats by name.

    Raises
    ------
    ConfigError
        If a format is unknown, or needs heights above the ellipsoid and no datum is given.
    """
    if not names:
        raise ConfigError(f"--format names no format; known are {', '.join(FORMATS)}")
    unknown = [name for name in names if name not in FORMATS]
    if unknown:
        near = get_close_matches(unknown[0].lower(), FORMATS, n=1)
        meant = f"; did you mean {near[0]}?" if near else ""
        raise ConfigError(f"--format {unknown[0]} is unknown{meant}; known are {', '.join(FORMATS)}")
    chosen = {name: FORMATS[name] for name in names}
    lacking = [name for name, kind in chosen.items() if kind.needs_datum]
    if lacking and options.datum is None:
        raise ConfigError(f"{lacking[0]} {DATUM_REMEDY}")
    return chosen
