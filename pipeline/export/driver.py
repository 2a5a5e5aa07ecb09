"""Write exports of a run in several formats, and the manifest that says what they are."""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from flexroad.catalog.storage.paths import Location, listing, write
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.export.formats import FORMATS, Format
from flexroad.pipeline.export.options import Options
from flexroad.pipeline.export.source import Source
from flexroad.pipeline.run.status import Track, untracked

MANIFEST = "export.json"
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
) -> dict[str, Any]:
    """Write the formats, each into a folder of its name, and the manifest last; return the manifest.

    Parameters
    ----------
    track : callable
        Shows the progress: takes the tiles of a format, its name and their number.

    Raises
    ------
    ConfigError
        If a format is unknown or needs a datum, or a tile's results cannot be read.
    OSError
        If a file cannot be written.
    """
    chosen = check_formats(formats, options)
    written = {}
    for name, kind in chosen.items():
        if isinstance(out, Path):
            (out / name).mkdir(parents=True, exist_ok=True)
        tiles = track(source.finished(), f"writing {name}", len(source.tiles))
        kind.write(source, tiles, out / name, options, executor)
        files = {path: stat.size for path, stat in listing(out / name).items() if not path.startswith(".")}
        written[name] = {
            "title": kind.title,
            "version": kind.version,
            "precision_m": kind.precision_m,
            "files": len(files),
            "bytes": sum(files.values()),
        }
    manifest = {
        "flexroad": version("flexroad"),
        "run": str(source.run.path),
        "variant": source.variant,
        "crs": source.crs,
        "vertical_crs": source.vertical,
        "datum": options.datum.text if options.datum else None,
        "tiles": len(source.tiles),
        "left_out": list(source.left_out),
        "formats": written,
    }
    write(out / MANIFEST, json.dumps(manifest, indent=1, allow_nan=False).encode())
    return manifest


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
        raise ConfigError(f"--format {unknown[0]} is unknown; known are {', '.join(FORMATS)}")
    chosen = {name: FORMATS[name] for name in names}
    lacking = [name for name, kind in chosen.items() if kind.needs_datum]
    if lacking and options.datum is None:
        raise ConfigError(f"{lacking[0]} {DATUM_REMEDY}")
    return chosen
