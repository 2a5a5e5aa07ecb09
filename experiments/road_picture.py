"""The picture of roads in docs/export.md, from an export of a run along its roads.

``PYTHONPATH=. python experiments/road_picture.py EXPORT OUT.png``, where EXPORT was made with
``flexroad export RUN --format crg,lines -o EXPORT``.

Left: the segments of the GeoPackage, coloured by grade. Right: the heights of the longest road of OpenCRG,
less a smooth profile along its middle, so that crown and bumps are seen, and some of its cross-sections.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np
import pyogrio
import pyopencrg
import shapely
from matplotlib.collections import LineCollection

from flexroad.tasks.types import Floats

LONGEST_M = 100.0
"""Length of the shown part of the road (m)."""
SECTIONS_M = (20.0, 50.0, 80.0)
"""Places of the cross-sections (m)."""


def main(export: Path, out: Path) -> None:
    """Draw the picture."""
    figure = plt.figure(figsize=(11, 4.6), layout="constrained")
    parts = figure.add_gridspec(2, 2, width_ratios=(1, 1.3))
    _plan(figure, figure.add_subplot(parts[:, 0]), next((export / "lines").glob("*.gpkg")))
    with (export / "crg" / "roads.csv").open() as file:
        longest = max(csv.DictReader(file), key=lambda row: float(row["length_m"]))
    road = pyopencrg.CrgRoad.read(export / "crg" / f"{longest['id']}.crg")
    _heights(figure, figure.add_subplot(parts[0, 1]), figure.add_subplot(parts[1, 1]), road)
    figure.savefig(out, dpi=100)


def _plan(figure: plt.Figure, axes: plt.Axes, file: Path) -> None:
    table = pyogrio.read_dataframe(file, layer="segments")
    lines = [shapely.get_coordinates(line) for line in table.geometry]
    corner = np.floor(np.concatenate(lines).min(axis=0))
    grades = LineCollection([line - corner for line in lines], cmap="coolwarm", linewidths=3)
    grades.set_array(table.grade_percent)
    most = float(np.quantile(np.abs(table.grade_percent), 0.99))
    grades.set_clim(-most, most)
    axes.add_collection(grades)
    axes.autoscale()
    axes.set(aspect="equal", xlabel="east (m)", ylabel="north (m)", title="lines: grade along the road")
    figure.colorbar(grades, ax=axes, label="grade (%)", shrink=0.8)


def _heights(figure: plt.Figure, plan: plt.Axes, across: plt.Axes, road: pyopencrg.CrgRoad) -> None:
    shown = road.u <= LONGEST_M
    u, v, z = road.u[shown], road.v, road.z[shown]
    above = 100 * (z - _profile(u, z)[:, None])
    image = plan.pcolormesh(u, v, above.T, cmap="viridis")
    figure.colorbar(image, ax=plan, label="cm")
    plan.set(xlabel="along (m)", ylabel="across (m)", title="crg: height above a smooth profile")
    for place in SECTIONS_M:
        row = int(np.searchsorted(u, place))
        plan.axvline(place, color="white", linewidth=1)
        across.plot(v, above[row], label=f"at {place:.0f} m")
    across.set(xlabel="across (m), left positive", ylabel="cm")
    across.legend(frameon=False)


def _profile(u: Floats, z: Floats) -> Floats:
    """Return the heights of the cubic that fits the middle of the road."""
    return np.asarray(np.polyval(np.polyfit(u, z[:, z.shape[1] // 2], 3), u))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
