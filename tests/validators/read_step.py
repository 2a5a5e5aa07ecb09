"""Read a STEP file by OpenCASCADE; print whether its shape is valid, and points of its surface, as JSON.

Usage: read_step.py FILE POINTS_PER_SIDE
"""

import json
import sys

import numpy as np
from OCP.BRep import BRep_Tool
from OCP.BRepCheck import BRepCheck_Analyzer
from OCP.IFSelect import IFSelect_RetDone
from OCP.STEPControl import STEPControl_Reader
from OCP.TopAbs import TopAbs_FACE
from OCP.TopExp import TopExp_Explorer
from OCP.TopoDS import TopoDS

MM_PER_M = 1000.0


def main(file: str, points_per_side: int) -> None:
    """Print the points in metres: OpenCASCADE reads into millimetres."""
    reader = STEPControl_Reader()
    assert reader.ReadFile(file) == IFSelect_RetDone, f"{file} cannot be read"
    reader.TransferRoots()
    shape = reader.OneShape()
    faces = []
    explorer = TopExp_Explorer(shape, TopAbs_FACE)
    while explorer.More():
        faces.append(BRep_Tool.Surface_s(TopoDS.Face(explorer.Current())))
        explorer.Next()
    (surface,) = faces
    u0, u1, v0, v1 = surface.Bounds()
    points = [
        [point.X() / MM_PER_M, point.Y() / MM_PER_M, point.Z() / MM_PER_M]
        for u in np.linspace(u0, u1, points_per_side)
        for v in np.linspace(v0, v1, points_per_side)
        for point in [surface.Value(float(u), float(v))]
    ]
    json.dump({"valid": BRepCheck_Analyzer(shape).IsValid(), "points": points}, sys.stdout)


main(sys.argv[1], int(sys.argv[2]))
