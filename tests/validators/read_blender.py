"""Print version and vertices of meshes as Blender imports them, x east, y north, z up (m), as JSON.

Usage: read_blender.py FILE ...: OBJ or GLB; run by an interpreter that has Blender's module ``bpy``
"""

import json
import os
import sys

import bpy

vertices = []
# Blender writes messages of its own to the standard output.
output = os.dup(1)
os.dup2(2, 1)
for file in sys.argv[1:]:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if file.endswith(".obj"):
        bpy.ops.wm.obj_import(filepath=file, forward_axis="Y", up_axis="Z")
    else:
        bpy.ops.import_scene.gltf(filepath=file)
    for item in bpy.data.objects:
        if item.type == "MESH":
            vertices.append([list(item.matrix_world @ vertex.co) for vertex in item.data.vertices])
with os.fdopen(output, "w") as out:
    json.dump({"version": bpy.app.version_string, "vertices": vertices}, out)
