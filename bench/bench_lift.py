"""`flexroad lift`: time and memory for a network of OpenDRIVE over a synthetic run.

Usage: bench_lift.py [ROADS]; 10,000 without.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from tests.make_city import make_city, south_west

LANE = '<lane id="{0}" type="driving" level="false"><width sOffset="0" a="3.2" b="0" c="0" d="0"/></lane>'
CENTER = '<center><lane id="0" type="none" level="false"/></center>'
LANES = (
    f'<lanes><laneSection s="0"><left>{LANE.format(1)}</left>{CENTER}<right>{LANE.format(-1)}'
    f"{LANE.format(-2)}</right></laneSection></lanes>"
)
LENGTHS = (12.0, 70.0)
"""Lengths of roads (m), in turn: as netconvert writes them, connecting roads and streets."""


def write_network(path: Path, corner: np.ndarray, roads: int) -> None:
    """Write streets and connecting roads of four geometries each, over the run."""
    rng = np.random.default_rng(0)
    with path.open("w") as file:
        file.write('<?xml version="1.0"?>\n<OpenDRIVE><header revMajor="1" revMinor="6">')
        file.write("<geoReference>EPSG:25832</geoReference></header>\n")
        for number in range(roads):
            length = LENGTHS[number % 2]
            x, y = corner + rng.uniform(60, 140, 2)
            heading, quarter = rng.uniform(0, 2 * np.pi), length / 4
            file.write(f'<road id="{number}" length="{length}" junction="-1">\n <planView>\n')
            for k, shape in enumerate(
                ("<line/>", '<arc curvature="0.02"/>', '<spiral curvStart="0.02" curvEnd="0"/>', "<line/>")
            ):
                file.write(
                    f'  <geometry s="{k * quarter}" x="{x}" y="{y}" hdg="{heading}" length="{quarter}">'
                    f"{shape}</geometry>\n"
                )
                x, y = x + quarter * np.cos(heading), y + quarter * np.sin(heading)
            file.write(f" </planView>\n {LANES}\n</road>\n")
        file.write("</OpenDRIVE>\n")


def main(roads: int) -> None:
    """Print time and memory of the command, start included."""
    with tempfile.TemporaryDirectory() as name:
        run = make_city(Path(name))
        source = Path(name, "in.xodr")
        write_network(source, south_west(run), roads)
        for lateral in ("none", "superelevation"):
            out = Path(name, f"{lateral}.xodr")
            command = [sys.executable, "-m", "flexroad", "lift", source, run, "-o", out, "--lateral", lateral]
            start = time.perf_counter()
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            _, status, used = os.wait4(process.pid, 0)
            took = time.perf_counter() - start
            assert status == 0
            print(
                f"OpenDRIVE, {lateral}: {roads} roads, {source.stat().st_size / 1e6:.1f} MB, {took:.1f} s, "
                f"{used.ru_utime + used.ru_stime:.1f} s of CPU, peak {used.ru_maxrss / 1024:.0f} MB"
            )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10_000)
