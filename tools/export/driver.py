"""Write exports of a run in several formats, and the manifest that describes them.

The folder lies outside the run. One export at a time writes it. Files that no export wrote stay.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from difflib import get_close_matches
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any

from flexroad.catalog.storage.outputs import output_file
from flexroad.catalog.storage.paths import (
    PROBE,
    Location,
    absolute,
    check_writable,
    exists,
    listing,
    read,
    write,
)
from flexroad.catalog.text import count
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import Executor
from flexroad.pipeline.graph.borders import has_borders
from flexroad.pipeline.run.lock import run_lock
from flexroad.pipeline.run.record import Run, check_own
from flexroad.pipeline.run.sampler import STEP_REMEDY
from flexroad.pipeline.run.status import Track, ended, untracked
from flexroad.tasks.errors import TaskError
from flexroad.tools.export.formats import FORMATS, Format
from flexroad.tools.export.source import Options, Source

SAME = ("variant", "crs", "tiles", "results")
"""Entries of the manifest that are equal if two exports into one folder have the same results."""
DATUM_REMEDY = (
    "needs heights above the ellipsoid of WGS 84, and the heights of a run are above a vertical datum; say "
    "which: --vertical EPSG:N (PROJ needs its grid), --vertical FILE (.gtx or .tif), or --vertical METRES"
)
MANIFEST = "export.json"
BEGUN = ".flexroad-export"
"""File with the formats of the folder. It is written first, so that it also names interrupted exports."""


def export(
    source: Source,
    out: Location,
    formats: Sequence[str],
    options: Options,
    executor: Executor,
    track: Track = untracked,
    notify: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """Write each format into a folder of its name, and the manifest last; return the manifest."""
    chosen = check_formats(formats, options)
    options = replace(options, formats=frozenset(chosen))
    if options.drape and all(tile.layer("dop") is None for tile in source.tiles):
        raise ConfigError(
            "--drape needs an orthophoto (layer dop), and no exported tile has one; leave out --drape"
        )
    for kind in chosen.values():
        if kind.check:
            kind.check(source, options)
    apart = not has_borders(source.run.config.chains[source.variant]["fit"])
    others = ", ".join(name for name in chosen if not FORMATS[name].of_roads)
    if apart and others and len(source.tiles) > 1:
        notify(f"{others}: the tiles of this run do not meet, and heights have steps there; {STEP_REMEDY}")
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
    with ended(tiles):
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
        **({"mesh_distances": source.mesh_distances} if kind.of_meshes else {}),
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
    """Return the manifest's entries of other formats in the folder, if they are from the same results."""
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
    """Return the formats by name."""
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


@contextmanager
def held(out: Location, run: Run, formats: Collection[str], notify: Callable[[str], None]) -> Iterator[None]:
    """Make the folder and hold its lock; a context manager.

    - `notify`: receives one line when the lock of a dead process is taken over.
    """
    for folder in (run.path, run.store):
        inside = [str(absolute(place)) for place in (out, *out.parents)]
        if str(absolute(folder)) in inside:
            raise ConfigError(f"--output {out} lies in the run ({folder}); choose a folder outside")
    begun = _begun(out, formats)
    check_writable(out)
    if isinstance(out, Path):
        output_file(out / MANIFEST)
    with run_lock(out, notify):
        remove_unfinished(out)
        names = "".join(f"{name}\n" for name in sorted(begun)).encode()
        if not exists(out / BEGUN) or read(out / BEGUN) != names:
            write(out / BEGUN, names)
        yield


def _begun(out: Location, formats: Collection[str]) -> set[str]:
    """Return the formats of the folder that this or an earlier export has begun."""
    begun = exists(out / BEGUN)
    if not begun and exists(out / MANIFEST):
        raise ConfigError(f"{out / MANIFEST} is not of an export; choose another folder with -o")
    earlier = set(read(out / BEGUN).decode(errors="replace").split()) if begun else set()
    for name in sorted({*formats} - earlier):
        check_own(out / name, lambda: False, "an export", "-o")
    return {*earlier, *formats}


def remove_unfinished(folder: Location, below: bool = False) -> None:
    """Remove temporary files of a killed export from a folder; a bucket has no such files.

    - `below`: whether folders inside it are searched, too.
    """
    if isinstance(folder, Path):
        for file in folder.rglob(".*") if below else folder.glob(".*"):
            if file.suffix == ".tmp" or file.name.startswith(PROBE):
                file.unlink(missing_ok=True)


def file_sizes(folder: Location) -> dict[str, int]:
    """Return the size of each file of a format (bytes), without files that only an export reads."""
    return {path: stat.size for path, stat in listing(folder).items() if not path.startswith(".")}
