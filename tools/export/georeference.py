"""Origin and CRS of local coordinates, for files whose format has no place for them."""

from __future__ import annotations

import json
from dataclasses import dataclass

from flexroad.catalog import crs


@dataclass(frozen=True)
class Georeference:
    """The place of local coordinates, in metres."""

    crs: str
    """CRS in metres: ``EPSG:25832``, or WKT where there is no code."""
    origin: tuple[float, float, float]
    """Easting, northing and height that local coordinates are relative to (m)."""
    vertical: str | None = None
    """CRS of the heights, or None if it is not known."""

    def lines(self) -> list[str]:
        """Return origin and CRSs as lines of ASCII text, for comments."""
        texts = [
            f"origin {' '.join(f'{v:.15g}' for v in self.origin)} (easting northing height, m)",
            f"crs {' '.join(self.crs.split())}",  # WKT may hold line breaks, which would end a comment
            f"vertical crs {' '.join(self.vertical.split()) if self.vertical else 'unknown'}",
        ]
        return [text.encode("ascii", "backslashreplace").decode() for text in texts]

    def sidecar(self, axes: str, **more: object) -> bytes:
        """Return a JSON document with the place, the meaning of the axes, and other entries.

        - `axes`: directions and units of the file's axes.
        - `more`: other entries; values that JSON has.
        """
        content = {
            "crs": self.crs,
            "crs_name": crs.name(self.crs),
            "vertical_crs": self.vertical,
            "origin": [float(v) for v in self.origin],
            "axes": axes,
            **more,
        }
        return json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False).encode() + b"\n"

    def prj(self) -> bytes:
        """Return the horizontal CRS as ``.prj`` file: WKT as ESRI writes it."""
        return crs.esri(self.crs).encode() + b"\n"
