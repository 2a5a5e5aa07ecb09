"""The folder that a run is written to: an empty or a new one, or that of a run, whole or damaged."""

from __future__ import annotations

from flexroad.catalog.storage.links import links_out
from flexroad.catalog.storage.paths import Location, entries, exists, visible_entry
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.graph.stages import STAGE_NAMES
from flexroad.pipeline.run.event_log import NAME as LOG
from flexroad.pipeline.run.lock import NAME as LOCK
from flexroad.pipeline.run.summary import read_summary
from flexroad.pipeline.store.records import DONE, FAILED

STORE = "store"
RECORD = "run.json"
"""The first file of a run: a folder that has it is a run, also if it is not complete."""


def check_links(path: Location, below: bool = False) -> None:
    """Check that no file or folder of a run is a link that leads out of the run.

    A run may come from anyone, and what is read, written or deleted behind such a link would not be the
    run's. Tiles and artefacts are checked when they are used (`contained`).

    Parameters
    ----------
    path : Location
        The run's folder, or a folder in it; itself it may be a link.
    below : bool
        Whether folders inside it are searched, too.

    Raises
    ------
    ConfigError
        If there is one, or the folder cannot be read.
    """
    try:
        link = next(links_out(path, below), None)
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror or error}; correct that") from error
    if link is not None:
        remedy = f"move the files to {link}"
        if link.name == STORE:
            remedy += f", or give their folder with --store {link.resolve()}, without the link"
        raise ConfigError(f"{link} is a link that leads out of {path}, to {link.resolve()}; {remedy}")


def check_folder(path: Location) -> None:
    """Check that a run may be written to a folder, so that no existing files are replaced.

    Raises
    ------
    ConfigError
        If the folder has other files and is no run, or cannot be read, or `check_links` raises.
    """
    try:
        other = None if exists(path / RECORD) else visible_entry(path, {LOCK, LOG})
        refused = other is not None and not _has_results(path)
    except OSError as error:
        reason = error.strerror or error
        raise ConfigError(f"cannot read {path}: {reason}; correct that or choose another --out") from error
    if refused:
        raise ConfigError(
            f"{path} has other files, such as {other}, and is no run; choose an empty or new one with --out"
        )
    check_links(path)


def _has_results(path: Location) -> bool:
    """Return whether a folder has results of a run, which can be resumed without its run.json."""
    if read_summary(path) or any(exists(path / "store" / stage) for stage in STAGE_NAMES):
        return True
    return any(name.endswith((f"/{DONE}", f"/{FAILED}")) for name, _ in entries(path / "tiles"))
