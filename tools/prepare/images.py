"""Photographs and textures: images with too many pixels are refused before they are decoded."""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from flexroad.catalog.lazy import lazy
from flexroad.catalog.text import one_line
from flexroad.tasks.errors import TaskError

if TYPE_CHECKING:
    import PIL.Image
else:
    PIL = lazy("PIL")

MOST_PIXELS = 400_000_000
"""Largest photograph or texture (pixels), 1.1 GiB as RGB. Sensors of drones have up to 150 million pixels,
textures of 16,384 x 16,384 texels 268 million. A PNG of 2 MB may have 2,500 million."""
# OpenCV reads its limit only at its first import.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MOST_PIXELS))


@contextlib.contextmanager
def bounded() -> Iterator[None]:
    """Context manager in which Pillow opens images up to `MOST_PIXELS`, without a warning."""
    # Pillow warns above its limit, and refuses images above twice the limit.
    before, PIL.Image.MAX_IMAGE_PIXELS = PIL.Image.MAX_IMAGE_PIXELS, MOST_PIXELS // 2
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PIL.Image.DecompressionBombWarning)
            yield
    finally:
        PIL.Image.MAX_IMAGE_PIXELS = before


@contextlib.contextmanager
def image_errors(failure: str, remedy: str, file: Path) -> Iterator[None]:
    """Context manager that limits images, and turns errors of reading into a `TaskError`.

    - `failure`: beginning of the message, such as "IMAGE cannot be read".
    """
    try:
        with bounded():
            yield
    except (TaskError, ImportError):
        raise
    except Exception as error:  # Pillow raises many types for damaged files
        if why := getattr(error, "strerror", None):
            raise TaskError(f"{failure}: {why}", file=str(file)) from error
        raise TaskError(f"{failure}: {one_line(error)}; {remedy}", file=str(file)) from error


def check_pixels(image: PIL.Image.Image, name: str, remedy: str, file: Path) -> None:
    """Check the size of an open image before its pixels are read."""
    if image.width * image.height > MOST_PIXELS:
        raise TaskError(
            f"{name} has {image.width:,} x {image.height:,} pixels, more than {MOST_PIXELS / 1e6:.0f} "
            f"million; {remedy}",
            file=str(file),
        )
