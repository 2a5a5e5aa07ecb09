"""The surface along a road as OpenCRG 1.2: a grid of heights along a curved line, for tyres and vehicles.

The file is KRBI: a text header, then binary rows of big-endian float32, filled with NaN to complete records.
A row has the heading and the heights across the road from right to left. Heights are relative to a whole
metre (``REFERENCE_LINE_START_Z``), so that float32 resolves micrometres.
"""

from __future__ import annotations

import numpy as np

from flexroad.catalog.text import printable
from flexroad.tasks.errors import TaskError
from flexroad.tools.export.profiles import HeightGrid

VERSION = 1
NAME = ".crg"

LINE = 72
"""Longest line of the header."""
HEADER_END = "$" * 80
RECORD = 20
"""Numbers in a record of 80 bytes."""

# A file without $ROAD_CRG_MODS gets default modifiers, which move the start of the line to the origin. The
# section is therefore written although it is empty.
HEADER = """\
$CT
{comment}
$
$ROAD_CRG_MODS
$
$ROAD_CRG
REFERENCE_LINE_START_U   = 0.0
REFERENCE_LINE_END_U     = {end_u:.3f}
REFERENCE_LINE_INCREMENT = {increment:.3f}
LONG_SECTION_V_RIGHT     = {right:.3f}
LONG_SECTION_V_LEFT      = {left:.3f}
LONG_SECTION_V_INCREMENT = {v_increment:.3f}
REFERENCE_LINE_START_X   = {x[0]!r}
REFERENCE_LINE_START_Y   = {y[0]!r}
REFERENCE_LINE_START_Z   = {datum:.1f}
REFERENCE_LINE_START_PHI = {phi[0]!r}
REFERENCE_LINE_END_X     = {x[1]!r}
REFERENCE_LINE_END_Y     = {y[1]!r}
REFERENCE_LINE_END_Z     = {datum:.1f}
REFERENCE_LINE_END_PHI   = {phi[1]!r}
$
$KD_DEFINITION
#:KRBI
U:reference line u,m,0.000,{increment:.3f}
D:reference line phi,rad
{sections}
$
{end}
"""


def encode(grid: HeightGrid, comment: str = "") -> bytes:
    """Return the heights along a reference line as OpenCRG.

    - `grid`: its x and y are written as they are; NaN are written as NaN.
    - `comment`: text for readers, such as the coordinate system of x, y and the heights; lines of 72
      characters.
    """
    line, known = grid.line, np.isfinite(grid.heights)
    if not known.any():
        place = f"x {line.x[0]:.1f}, y {line.y[0]:.1f}"
        raise TaskError(f"the road at {place} has no height: leave out roads beyond the surface")
    datum = float(np.round(grid.heights[known].mean()))
    phi = line.chord_headings
    # ``$`` in a comment would begin a section.
    texts = [printable(text).replace("$", "S").encode("ascii", "replace") for text in comment.splitlines()]
    short = [text[at : at + LINE] for text in texts for at in range(0, max(1, len(text)), LINE)]
    header = HEADER.format(
        comment=b"\n".join(short).decode(),
        end_u=(len(line.x) - 1) * line.increment,
        increment=line.increment,
        right=grid.v[0],
        left=grid.v[-1],
        v_increment=grid.v[1] - grid.v[0],
        x=(float(line.x[0]), float(line.x[-1])),
        y=(float(line.y[0]), float(line.y[-1])),
        phi=(float(phi[0]), float(phi[-1])),
        datum=datum,
        sections="\n".join(f"D:long section {k + 1},m" for k in range(len(grid.v))),
        end=HEADER_END,
    )
    # The heading of a row is the heading of the chord that ends there. Readers ignore it in the first row.
    rows = np.column_stack([np.concatenate([phi[:1], phi]), grid.heights - datum])
    filling = np.full(-rows.size % RECORD, np.nan)
    return header.encode("ascii") + np.concatenate([rows.ravel(), filling]).astype(">f4").tobytes()
