"""The folder of an export: outside the run, written by one export at a time; existing files stay."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from flexroad.catalog.storage.outputs import output_file
from flexroad.catalog.storage.paths import (
    PROBE,
    Location,
    absolute,
    check_writable,
    exists,
    listing,
    read,
    visible_entry,
    write,
)
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.lock import run_lock
from flexroad.pipeline.run.record import Run

MANIFEST = "export.json"
BEGUN = ".flexroad-export"
"""File with the formats of the folder: written first, so that an interrupted export is known, too."""


@contextmanager
def held(out: Location, run: Run, formats: Collection[str], notify: Callable[[str], None]) -> Iterator[None]:
    """Make the folder and hold its lock; a context manager.

    Parameters
    ----------
    formats : collection of str
        The formats to write, each into a folder of its name.
    notify : callable
        Receives one line when the lock of a dead process is taken over.

    Raises
    ------
    ConfigError
        If the folder is the run, its store or inside one of them, has existing files that would be replaced,
        or another process writes there.
    OSError
        If it, or its manifest, cannot be written.
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
    """Return the formats of the folder that this or an earlier export has written or begun.

    Raises
    ------
    ConfigError
        If the manifest, or a file in the folder of a format, is not of an earlier export.
    """
    own = _formats(out)
    if own is None and exists(out / MANIFEST):
        raise _foreign(out / MANIFEST)
    earlier = own or set()
    for name in formats:
        other = None if name in earlier else visible_entry(out / name)
        if other is not None:
            raise _foreign(out / name / other)
    return {*earlier, *formats}


def _formats(out: Location) -> set[str] | None:
    """Return the formats of earlier exports into the folder, None if there was none."""
    if exists(out / BEGUN):
        return set(read(out / BEGUN).decode(errors="replace").split())
    try:
        # An export of an earlier version.
        manifest = json.loads(read(out / MANIFEST)) if exists(out / MANIFEST) else {}
        return set(manifest["formats"]) if manifest["flexroad"] else None
    except (IsADirectoryError, ValueError, KeyError, TypeError):
        return None


def _foreign(file: Location) -> ConfigError:
    return ConfigError(
        f"{file} is not of an earlier `flexroad export` and would be replaced; "
        "choose another folder with -o, or move that file away"
    )


def remove_unfinished(folder: Location, below: bool = False) -> None:
    """Remove temporary files that an export which was killed has left in a folder; a bucket has none.

    Parameters
    ----------
    below : bool
        Whether folders inside it are searched, too.
    """
    if isinstance(folder, Path):
        for file in folder.rglob(".*") if below else folder.glob(".*"):
            if file.suffix == ".tmp" or file.name.startswith(PROBE):
                file.unlink(missing_ok=True)


def file_sizes(folder: Location) -> dict[str, int]:
    """Return the size of each file of a format (bytes), without those that only an export reads."""
    return {path: stat.size for path, stat in listing(folder).items() if not path.startswith(".")}
