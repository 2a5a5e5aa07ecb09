"""Sampling and evaluation of one 250 x 250 tile, compared with general libraries for parts of them."""

from collections.abc import Callable

import numpy as np
import trimesh
from matplotlib.tri import LinearTriInterpolator, Triangulation
from scipy.spatial import Delaunay

from flexroad.catalog.grid import Grid
from flexroad.tasks import sample
from flexroad.tasks.filter import ecsrc
from flexroad.tasks.fit import nurbs, raster
from flexroad.tasks.meshing.triangulate import delaunay
from flexroad.tasks.metrics import evaluate, mesh_check
from flexroad.tasks.metrics.dihedral import mean_angles
from flexroad.tasks.metrics.vertical_distance import drape
from flexroad.tasks.synthetic.scene import make_scene
from flexroad.tasks.types import Mesh, RoadMask, TileData
from tests.bench.timing import cpu_s

GRID = Grid("EPSG:25832", 295500.0, 5629500.0, 1.0, 250, 250)


def best(function: Callable[[], object], repeats: int = 7) -> float:
    return 1e3 * cpu_s(function, repeats)


def line(label: str, faces: int, ours: float, peer: str = "", theirs: float = 0.0) -> None:
    ratio = f"{peer} {theirs:7.1f} ms, {theirs / ours:5.1f} times ours" if peer else ""
    print(f"{label:21}{faces:8} faces {ours:7.1f} ms   {ratio}")


def peers_of_evaluate(name: str, mesh: Mesh) -> None:
    """Compare `drape` and `mean_angles` with other libraries on the same faces."""
    x, y, z = mesh.vertices.T
    inside = np.meshgrid(GRID.eastings[1:-1] - mesh.origin[0], GRID.northings[1:-1] - mesh.origin[1])
    faces = Triangulation(x, y, mesh.faces)
    heights = drape(mesh, GRID)[1:-1, 1:-1]
    peer = LinearTriInterpolator(faces, z)(*inside)
    assert np.abs(heights - peer).max() < 1e-6
    theirs = best(lambda: LinearTriInterpolator(Triangulation(x, y, mesh.faces), z)(*inside), 2)
    line(f"drape {name}", len(mesh.faces), best(lambda: drape(mesh, GRID)), "matplotlib", theirs)

    def by_trimesh() -> float:
        return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).face_adjacency_angles.mean()

    line(f"MAD {name}", len(mesh.faces), best(lambda: mean_angles(mesh)), "trimesh   ", best(by_trimesh, 2))


def main() -> None:
    scene = make_scene(GRID, 1, "urban")
    data = TileData("bench", GRID, GRID, scene.dsm, scene.dtm, reference=scene.reference)
    road = RoadMask(GRID, GRID, scene.road_mask, np.zeros(GRID.shape, bool))
    clusters = ecsrc.ecsrc(data, road, ecsrc.Options())
    print(f"{road.mask.mean():.0%} road")
    surfaces = {
        "dynamic": nurbs.fit(data, clusters, nurbs.Options()),
        "uniform": raster.fit(data, clusters, raster.Options()),
    }
    meshes = {}
    for method, surface in surfaces.items():
        options = sample.Options(method=method)
        mesh = meshes[method] = sample.sample(surface, road, clusters, options)
        time_ms = best(lambda s=surface, o=options: sample.sample(s, road, clusters, o))
        line(f"sample {method}", len(mesh.faces), time_ms)
    plan = meshes["dynamic"].vertices
    lattices = [((plan[:, 0].min(), plan[:, 1].min()), 1.0)]
    ours = best(lambda: delaunay(plan, lattices))
    line("Delaunay", len(meshes["dynamic"].faces), ours, "scipy     ", best(lambda: Delaunay(plan[:, :2])))
    for name, mesh in meshes.items():
        for nearest in (False, True):
            options = evaluate.Options(nearest=nearest)
            time_ms = best(lambda m=mesh, o=options: evaluate.evaluate(m, data, road, o))
            line(f"evaluate {name}{' +3D' * nearest}", len(mesh.faces), time_ms)
        line(f"check {name}", len(mesh.faces), best(lambda m=mesh: mesh_check.check(m)))
        peers_of_evaluate(name, mesh)


if __name__ == "__main__":
    main()
