"""The output folder of a ``prepare`` command: its files, which files it may replace, and its errors."""

from __future__ import annotations

import contextlib
import errno
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn

from flexroad.catalog import LAYERS
from flexroad.catalog.guard.open_raster import ERRORS, open_raster
from flexroad.catalog.storage.outputs import output_file
from flexroad.catalog.storage.scratch import ScratchFolder
from flexroad.catalog.text import write_reason
from flexroad.pipeline.errors import ConfigError

CATALOG = "catalog.parquet"
NAMES = (CATALOG, *(f"{layer}.tif" for layer in LAYERS))
"""The files that a command writes; existing files with these names are replaced or removed."""
LAYER_TAG = "LAYER"
"""TIFF tag with the layer of a raster; it shows that this program has written the file."""
FULL = (errno.ENOSPC, errno.EDQUOT)
FULL_BYTES = 2**24
"""If an error has no number, like GDAL's errors, a disk with less free space is taken as full."""


def check_replaced(out: Path) -> None:
    """Check that all files that will be replaced in an output folder are from an earlier ``prepare``.

    Such a raster has the tag of its layer. Such a catalog lies next to such a DSM, because it is removed
    before the rasters and written after them.
    """
    if not out.is_dir():
        if out.exists():
            raise ConfigError(f"{out} is a file; choose a folder with -o")
        return
    for name in NAMES:
        with disk_errors(out / name):
            present = output_file(out / name).exists()
        if present and not _is_own(out / ("dsm.tif" if name == CATALOG else name)):
            raise ConfigError(
                f"{out / name} is not of an earlier `flexroad prepare` and would be replaced; "
                "choose another folder with -o, or move that file away"
            )


def _is_own(raster: Path) -> bool:
    try:
        with open_raster(raster) as source:
            return bool(source.tags().get(LAYER_TAG) == raster.stem)
    except ERRORS:
        return False


@contextlib.contextmanager
def disk_errors(where: Path) -> Iterator[None]:
    """Context manager that turns an `OSError` of the disk into a `ConfigError` of one line."""
    try:
        yield
    except OSError as error:
        raise write_error(where, error) from error


@contextlib.contextmanager
def scratch_folder(out: Path) -> Iterator[Path]:
    """Context manager that makes a hidden temporary folder inside ``out`` and removes it at the end.

    ``out`` is created if it does not exist, and removed again if nothing was written to it.
    """
    new = not out.exists()
    try:
        with contextlib.ExitStack() as stack:
            with disk_errors(out):
                out.mkdir(parents=True, exist_ok=True)
                folder = Path(stack.enter_context(ScratchFolder(out)))
            yield folder
    finally:
        if new:
            # Fails, as intended, if the folder has published rasters.
            with contextlib.suppress(OSError):
                out.rmdir()


def write_error(where: Path, error: Exception) -> ConfigError:
    """Return the error of a file or folder that cannot be written: one line with reason and remedy."""
    number = getattr(error, "errno", None)
    is_full = free_bytes(where) < FULL_BYTES if number is None else number in FULL
    remedy = "free disk space and repeat" if is_full else "correct that or choose another folder with -o"
    return ConfigError(f"cannot write to {where}: {write_reason(error)}; {remedy}")


def free_bytes(where: Path) -> int:
    """Return the free space on the disk of a file or folder, which need not exist."""
    existing = next(folder for folder in (where.absolute(), *where.absolute().parents) if folder.exists())
    return shutil.disk_usage(existing).free


def on_failure(name: Callable[[Any], object], remedy: str = "use fewer workers") -> Callable[[Any, str], Any]:
    """Return a function for an executor that raises a `ConfigError` for a job whose worker died.

    - `name`: returns the input of a job, for the message.
    - `remedy`: advice for the user; empty if unknown.
    """

    def fail(job: Any, reason: str) -> NoReturn:
        raise ConfigError("; ".join(filter(None, (f"{name(job)}: {reason}", remedy))))

    return fail
