"""Print the heights at which rays from above hit height fields or OBJ meshes in MuJoCo, by their JSON.

Usage: cast_rays.py FOLDER < JSON with eastings and northings of the rays (m)
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
    name, position = str(number), np.subtract(place["origin"], origin)
    if settings := place.get("mujoco"):
        spec.add_hfield(name=name, file=str(file.with_suffix(".bin").absolute()), size=settings["size"])
        kind = {"type": mujoco.mjtGeom.mjGEOM_HFIELD, "hfieldname": name}
        position = position + settings["pos"]
    else:
        # A surface without thickness has no volume.
        shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        spec.add_mesh(name=name, file=str(file.with_suffix(".obj").absolute()), inertia=shell)
        kind = {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": name}
    spec.worldbody.add_geom(**kind, pos=position)
model = spec.compile()
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
hits = []
for easting, northing in json.load(sys.stdin):
    start, down = np.array([easting, northing, 1000 + origin[2]]) - origin, np.array([0.0, 0.0, -1.0])
    distance = mujoco.mj_ray(model, data, start, down, None, 1, -1, np.zeros(1, np.int32))
    hits.append(start[2] - distance + origin[2] if distance >= 0 else None)
json.dump(hits, sys.stdout)
