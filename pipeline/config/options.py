"""Fields of dataclasses that are options of commands, and the headings of help pages that list options."""

from __future__ import annotations

from dataclasses import field
from typing import Any

INPUTS, OUTPUTS, TILES = "Inputs", "Outputs", "Tiles"
METHOD, VALIDATION = "Method", "Split into training and validation"
POINTS, MESH, PHOTOS, RASTERS = "Points", "Mesh", "Photos", "Rasters"
WORK = "Parallel work"
HEADINGS = (INPUTS, METHOD, VALIDATION, POINTS, MESH, PHOTOS, RASTERS, TILES, OUTPUTS, WORK)
"""The headings in their order on a help page."""
MIN_COVER_HELP = "Leave out tiles with a DSM height in less than this share of their cells; 0 keeps all."


def option(default: Any, heading: str, help: str, metavar: str | None = None, **more: Any) -> Any:
    """Return a field of a dataclass; `pipeline.cli.options.with_options` makes an option from it.

    - `default`: default of the field; `dataclasses.MISSING` if it is required. A field that is True by
      default becomes a flag ``--no-...``, whose help says what is left out.
    - `heading`, `help`, `metavar`: the heading on the help page, the meaning, and the word for the value.
    - `more`: limits ``min`` and ``max``; ``name``, if it differs from the field's name without its unit.
    """
    return field(default=default, metadata={"heading": heading, "help": help, "metavar": metavar, **more})
