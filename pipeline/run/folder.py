"""The folder that a run is written to: an empty or a new one, or that of a run, whole or damaged."""

from __future__ import annotations

from flexroad.catalog.storage.paths import Location, entries, exists, visible_entry
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.graph.stages import STAGE_NAMES
from flexroad.pipeline.run.event_log import NAME as LOG
from flexroad.pipeline.run.lock import NAME as LOCK
from flexroad.pipeline.run.summary import read_summary
from flexroad.pipeline.store.records import DONE, FAILED

RECORD = "run.json"
"""The first file of a run: a folder that has it is a run, also if it is not whole."""


def check_folder(path: Location) -> None:
    """Check that a run may be written to a folder, so that no files of others are replaced.

    Raises
    ------
    ConfigError
        If the folder has other files and is no run, or cannot be read.
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


def _has_results(path: Location) -> bool:
    """Return whether a folder has results of a run, which can be resumed without its run.json."""
    if read_summary(path) or any(exists(path / "store" / stage) for stage in STAGE_NAMES):
        return True
    return any(name.endswith((f"/{DONE}", f"/{FAILED}")) for name, _ in entries(path / "tiles"))
