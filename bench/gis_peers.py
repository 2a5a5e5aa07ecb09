"""Peers of `bench_peers` that are programs: GMT and GRASS, where they are installed.

On Debian: ``apt install gmt grass-core``. Both get the same points as the libraries, as text. Their CPU time
includes only the module, not reading the points into GRASS and writing the raster. The settings have the
lowest road error among a few that were tried on the same tile. So the peers do at least as well as by
default.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from flexroad.tasks.types import Floats

BLOCK_M = 3
"""Side of the blocks that GMT averages before it fits (m)."""
SPACING_M, LAMBDA = 3.6, 0.03
"""Distance of the knots of GRASS's splines, as ours, and their smoothing."""

Program = Callable[[Floats, Floats, Floats], tuple[Floats, float]]
"""Takes x, y ``(n,)`` and points ``(p, 3)``; returns heights at all cells ``(H, W)``, m, and CPU s."""


def installed() -> dict[str, Program]:
    """Return the programs that this machine has, by name."""
    peers: dict[str, Program] = {}
    if shutil.which("gmt"):
        peers["GMT surface of block means"] = gmt_surface
    if shutil.which("grass"):
        steps = f"ew_step={SPACING_M} ns_step={SPACING_M} lambda_i={LAMBDA}"
        peers["GRASS v.surf.bspline"] = grass(f"v.surf.bspline method=bicubic {steps} raster_output")
        peers["GRASS v.surf.rst"] = grass("v.surf.rst tension=20 smooth=1 npmin=100 elevation")
    return peers


def gmt_surface(x: Floats, y: Floats, points: Floats) -> tuple[Floats, float]:
    region = f"-R{x[0]}/{x[-1]}/{y[-1]}/{y[0]}"
    # GMT 6.4 writes a GeoTIFF some rows off if it has enlarged the grid; heights are taken as plain numbers.
    script = f"""
        time {{ gmt blockmean points.txt {region} -I{BLOCK_M} > blocks.txt
                gmt surface blocks.txt {region} -I1 -T0 -C0.001 -Gout.nc; }}
        gmt grd2xyz out.nc -ZTLd > out.bin"""
    return run(script, points, (len(y), len(x)))


def grass(command: str) -> Program:
    """Return the peer of a GRASS module; ``command`` ends with the name of its output option."""
    module, *options, output = command.split()

    def program(x: Floats, y: Floats, points: Floats) -> tuple[Floats, float]:
        half = abs(x[1] - x[0]) / 2
        script = f"""
            g.region n={y[0] + half} s={y[-1] - half} w={x[0] - half} e={x[-1] + half} res={2 * half}
            v.in.ascii -ztn input=points.txt output=points separator=space z=3
            time {module} input=points {" ".join(options)} {output}=out
            r.out.bin -f input=out output=out.bin bytes=8"""
        return run(script, points, (len(y), len(x)), "grass --tmp-location XY --exec")

    return program


def run(script: str, points: Floats, shape: tuple[int, int], within: str = "") -> tuple[Floats, float]:
    """Run a shell script beside the points; return the heights that it wrote and the CPU time it measured."""
    with tempfile.TemporaryDirectory() as folder:
        np.savetxt(Path(folder, "points.txt"), points, fmt="%.4f")
        Path(folder, "job.sh").write_text(f"set -e\nTIMEFORMAT='CPU %U %S'\n{script}\n")
        done = subprocess.run(
            [*within.split(), "bash", "job.sh"],
            cwd=folder,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
        )
        if done.returncode:
            raise SystemExit(f"{script.strip()}\nfailed: {done.stderr[-500:]}")
        clock = next(line for line in done.stderr.splitlines() if line.startswith("CPU "))
        heights = np.fromfile(Path(folder, "out.bin")).reshape(shape)
    return heights, sum(map(float, clock.split()[1:]))
