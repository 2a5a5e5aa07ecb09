"""Run ``read_step.py``: the surface of a STEP file as OpenCASCADE reads it."""

import json
import subprocess
from pathlib import Path

import numpy as np

from tests import validators

SCRIPT = Path(__file__).parent / "read_step.py"


def read_step(file: Path, points_per_side: int) -> tuple[bool, np.ndarray]:
    """Return whether the shape is valid, and points of its surface, ``(n, 3)``, in metres."""
    command = [validators.python(), SCRIPT, file, str(points_per_side)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    # OpenCASCADE writes messages of its own before.
    found = json.loads(done.stdout[done.stdout.index('{"valid"') :])
    return found["valid"], np.array(found["points"])
