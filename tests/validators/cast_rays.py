"""Print the heights at which rays from above hit height fields in MuJoCo, with the settings of their JSON.

The points are read from the standard input: eastings and northings (m), as JSON.
"""

import json
import sys
from pathlib import Path

import mujoco
import numpy as np

fields = [(file, json.loads(file.read_text())) for file in sorted(Path(sys.argv[1]).glob("*.json"))]
origin = np.array(fields[0][1]["origin"])
spec = mujoco.MjSpec()
for number, (file, place) in enumerate(fields):
    settings = place["mujoco"]
    spec.add_hfield(name=str(number), file=str(file.with_suffix(".bin").absolute()), size=settings["size"])
    position = np.add(settings["pos"], np.subtract(place["origin"], origin))
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=str(number), pos=position)
model = spec.compile()
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
hits = []
for easting, northing in json.load(sys.stdin):
    start, down = np.array([easting, northing, 1000 + origin[2]]) - origin, np.array([0.0, 0.0, -1.0])
    distance = mujoco.mj_ray(model, data, start, down, None, 1, -1, np.zeros(1, np.int32))
    hits.append(start[2] - distance + origin[2] if distance >= 0 else None)
json.dump(hits, sys.stdout)
