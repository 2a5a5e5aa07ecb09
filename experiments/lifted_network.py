"""Draw docs/images/lift.webp: a network of SUMO before and after `flexroad lift`.

``python experiments/lifted_network.py FLAT.net.xml LIFTED.net.xml PICTURE``. The picture in docs is of
Autzen's centre lines by netconvert, over the run of docs/results/real_data.md, with ``--beyond flat``.
"""

import sys
from pathlib import Path
from xml.etree import ElementTree as ET

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection

TIMES = 20
"""Heights are drawn so many times too high."""
ASKEW, FLAT = 0.35, 0.55
"""The view from the south: shift to the east and shrinking to the north per metre northwards."""
TITLES = (
    "the network as netconvert writes it",
    "after flexroad lift (heights drawn {} times too high; grey: at {:.0f} m)",
)


def lanes(path: Path) -> list[np.ndarray]:
    """Return the points of each lane, ``(n, 3)``; height 0 where it has none."""
    shapes = (lane.attrib["shape"].split() for lane in ET.parse(path).iter("lane"))
    return [np.array([[float(v) for v in (*point.split(","), 0)[:3]] for point in shape]) for shape in shapes]


def seen(points: np.ndarray, base: float) -> np.ndarray:
    """Return the segments of a line in the picture, ``(n - 1, 2, 2)``."""
    x, y, z = points.T
    flat = np.column_stack([x + ASKEW * y, FLAT * y + TIMES * (z - base)])
    return np.stack([flat[:-1], flat[1:]], axis=1)


def main(flat: Path, lifted: Path, picture: Path) -> None:
    """Draw both networks, one above the other."""
    networks = lanes(flat), lanes(lifted)
    heights = np.concatenate([lane[:, 2] for lane in networks[1]])
    base, top = np.floor(heights.min()), np.ceil(heights.max())
    figure = plt.figure(figsize=(9, 6), dpi=100)
    for number, (network, title) in enumerate(zip(networks, TITLES, strict=True)):
        axes = figure.add_axes((0.01, 0.52 - 0.5 * number, 0.88, 0.46))
        level = [np.column_stack([lane[:, :2], np.full(len(lane), base)]) for lane in network]
        ground = np.concatenate([seen(lane, base) for lane in level])
        axes.add_collection(LineCollection(ground, linewidths=1.0, color="0.85" if number else "0.4"))
        if number:
            lines = LineCollection(np.concatenate([seen(lane, base) for lane in network]), linewidths=1.6)
            lines.set_array(np.concatenate([(lane[:-1, 2] + lane[1:, 2]) / 2 for lane in network]))
            lines.set_clim(base, top)
            axes.add_collection(lines)
        axes.autoscale()
        axes.set_aspect("equal")
        axes.set_axis_off()
        axes.set_title(title.format(TIMES, base), fontsize=11, loc="left")
    bar = figure.colorbar(lines, cax=figure.add_axes((0.91, 0.1, 0.018, 0.3)))
    bar.set_label("height (m)")
    figure.savefig(picture)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
