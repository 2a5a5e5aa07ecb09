"""The folder of an export: one export at a time writes it, and it is not a part of the run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from flexroad.catalog.storage.outputs import output_file
from flexroad.catalog.storage.paths import Location, absolute, listing
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.lock import run_lock
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.store.artefacts import PROBE, check_writable

MANIFEST = "export.json"


@contextmanager
def held(out: Location, run: Run, notify: Callable[[str], None]) -> Iterator[None]:
    """Make the folder and hold its lock; a context manager.

    Parameters
    ----------
    notify : callable
        Receives one line when the lock of a dead process is taken over.

    Raises
    ------
    ConfigError
        If the folder is the run, its store or inside one of them, or another process writes there.
    OSError
        If it, or its manifest, cannot be written.
    """
    for folder in (run.path, run.store):
        inside = [str(absolute(place)) for place in (out, *out.parents)]
        if str(absolute(folder)) in inside:
            raise ConfigError(f"--output {out} lies in the run ({folder}); choose a folder outside")
    check_writable(out)
    if isinstance(out, Path):
        output_file(out / MANIFEST)
    with run_lock(out, notify):
        remove_unfinished(out)
        yield


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
