"""A replacement for the paper's dataset DSC3D: five urban scenes as textured meshes with faults.

The paper describes five scenes with meshes of 35 to 101 thousand triangles and height differences of 4.5 m to
33.9 m. Its table gives RGT 45 thousand triangles: a square of 150 m with cells of 1 m.
``docs/results/causes.md``, section 7, compares the numbers with the paper's.

Photogrammetry sees walls only at flat angles, and uniform surfaces give no matching points. So edges become
slopes, cars and trees become smooth bumps, and asphalt becomes uneven. Areas without matches are bridged by a
smooth surface or left open.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from itertools import count

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import brentq
from scipy.special import ndtri

from flexroad.catalog.grid import Grid
from flexroad.catalog.lazy import lazy
from flexroad.tasks.types import Bools, Floats
from flexroad.tools.prepare.mesh.sample import TexturedMesh
from flexroad.tools.synthetic.orthophoto import orthophoto
from flexroad.tools.synthetic.scene import Scene, make_scene, true_height
from flexroad.tools.synthetic.spoilers import Kind
from flexroad.tools.synthetic.world import SOUTH_M, WEST_M, SceneOptions, field, generator, waves

CRS = "EPSG:32632"
"""UTM zone 32 on WGS 84, like DSC3D's meshes."""
SIZE_M = 150
APART_M = 3000
"""Distance between scenes (m), as in the benchmark: more than the longest wave of the hills."""
STEEPEST = 0.2
"""Greatest root mean square slope of a scene's hills."""
HUMPS, BANKS = 0.1, 0.05
"""Root mean square height of a scene's humps and embankments, as fractions of its rise."""
COARSE_M = 3.0
"""Cell size used to check whether a location suits a scene (m)."""
PIL, pv = lazy("PIL"), lazy("pyvista")
rasterio, trimesh = lazy("rasterio"), lazy("trimesh")

BUMP_WAVES_M = (1.5, 15.0)
"""Shortest and longest wave of the bumps (m)."""
BLANK_M = (4.0, 20.0)
"""Shortest and longest wave of the random field that places areas without matches (m)."""
TEXTURELESS = (Kind.GROUND, Kind.DECK, Kind.PAVED, Kind.BUILDING)
"""Kinds of cells that may have no texture: asphalt (on roads and car parks) and flat roofs."""
OVERHEAD_M, ALLEY_M = 4.0, 2.0
"""Ground may be hidden within `ALLEY_M` of a surface that is `OVERHEAD_M` higher (m)."""
MELT_M, BUMPS_M = 0.6, 0.04
"""Gaussian smoothing of all edges, and root mean square height of bumps (m)."""
BRIDGED_M2, OPEN = 8.0, 0.3
"""Area up to which holes are always bridged (m2), and fraction of the larger holes that stay open."""
FRAGMENTS = 8
"""Number of floating pieces of surface."""
GHOST = 0.25
"""Fraction of the height of moving objects that remains."""
NODE_M = 0.5
"""Node spacing of the lattice before simplification (m): 300 x 300 quads, 180,000 triangles."""
GSD_M = 0.25
"""Pixel size of the texture (m)."""
FLOATING_M = (2.0, 9.0)
"""Range of the height of floating fragments over the surface (m)."""
Faces = NDArray[np.int32]
FRAGMENT_M = (0.4, 1.5)
"""Least and greatest radius of a floating fragment (m)."""
RIM = 7
"""Number of corners of a floating fragment."""


@dataclass(frozen=True)
class _Site:
    """Properties of one scene, independent of its location."""

    name: str
    stratum: str
    rise_m: float
    """Height difference of its true ground (m)."""
    triangles: int
    """Number of triangles of its mesh."""
    options: SceneOptions
    """Slope, humps, embankments and direction are set from the rise and the location."""
    blank: float = 0.04
    """Fraction of the surfaces without texture that have no matches."""
    hidden: float = 0.1
    """Fraction of the ground at walls that no photograph shows. It was fitted to RGT on roads, 0.195 m:
    ground bridged at walls is too high, and the mask covers it."""


TOWN = SceneOptions(
    block_m=75,
    density=0.7,
    stream_share=0.0,
    dsm_noise_m=(0.0, 0.0),
    cross_slope=0.02,
    curb_m=0.12,
    # T is 40K, RGT has 45K: the mask covers 89%, which is all ground between roofs and crowns.
    open_ground=1.0,
    built=0.45,
    trees=0.6,
    # RGT on terrain is 15.411 m: only roofs and crowns are not road.
    storeys=1.5,
    overhang_m=0.4,
    # RGT's road MAD, if lawns are road.
    growth_m=0.1,
    car_parks=0.1,
)
SUBURB = TOWN.model_copy(update={"block_m": 80, "storeys": 2.2})

SITES = (
    _Site("boulevard", "urban", 4.5, 101_000, TOWN.model_copy(update={"block_m": 90.0})),
    _Site("courtyards", "urban", 8.0, 78_000, TOWN.model_copy(update={"built": 0.5}), hidden=0.2),
    _Site("garden_suburb", "suburban", 14.0, 35_000, SUBURB),
    _Site("hillside", "suburban", 23.0, 46_000, SUBURB),
    _Site("steep_quarter", "urban", 33.9, 60_000, TOWN, blank=0.06),
)
"""Least and greatest rise and number of triangles are the paper's; other values are assumed."""


@dataclass(frozen=True)
class Place:
    """A scene at its location in a world."""

    site: _Site
    grid: Grid
    """Its grid with cells of 1 m."""
    options: SceneOptions


def survey(scenes: int = len(SITES), seed: int = 0) -> list[Place]:
    """Return the locations of the first ``scenes`` scenes in a world.

    A scene gets the first location of its row where hills with a slope of at most `STEEPEST` give its rise.
    Then the slope is set so that they give exactly its rise.

    - `scenes`: number of scenes, the first of `SITES`.
    """
    return [_locate(row, site, seed) for row, site in enumerate(SITES[:scenes])]


def _locate(row: int, site: _Site, seed: int) -> Place:
    for number in count():
        west, south = WEST_M + number * APART_M, SOUTH_M - (row + 1) * APART_M
        turn = generator(seed, "dsc3d", row, number).uniform(0, 90)
        turned = _with(
            site.options, turn_deg=turn, roughness_m=HUMPS * site.rise_m, embankment_m=BANKS * site.rise_m
        )
        excess = partial(_excess, site, turned, _square(west, south, COARSE_M), seed)
        if excess(0.0) < 0 < excess(STEEPEST):
            slope = brentq(excess, 0.0, STEEPEST, xtol=1e-4)
            return Place(site, _square(west, south, 1.0), _with(turned, slope=slope))
    raise AssertionError("unreachable: the loop has no end")


def _excess(site: _Site, options: SceneOptions, grid: Grid, seed: int, slope: float) -> float:
    """Return the rise of the ground at a location minus the rise of the site (m), for a slope."""
    empty = _with(options, slope=slope, density=0.0)
    return float(np.ptp(true_height(grid, seed, site.stratum, empty))) - site.rise_m


def _square(west: float, south: float, cell: float) -> Grid:
    cells = round(SIZE_M / cell)
    return Grid(CRS, west, south + SIZE_M, cell, cells, cells)


def _with(options: SceneOptions, **changed: float) -> SceneOptions:
    return SceneOptions(**options.model_dump() | changed)


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A reconstructed surface, on the lattice of its scene."""

    grid: Grid
    height: Floats
    """``(H, W)``, m; also defined in open holes."""
    bridged: Bools
    """Holes filled by a smooth surface, ``(H, W)``."""
    open: Bools
    """Holes without a surface, ``(H, W)``."""


def reconstruct(scene: Scene, seed: int, site: _Site) -> Reconstruction:
    """Return a scene's surface with the faults of a reconstruction.

    - `scene`: a scene without noise; cells of 0.5 m resolve cars and walls.
    - `seed`: seed of the world; bumps and holes are functions of seed and coordinates.
    """
    grid = scene.grid
    smoothed = ndimage.gaussian_filter(_static_surface(scene), MELT_M / grid.cell, mode="nearest")
    uneven = smoothed + _bumps(grid, seed)
    holes = _textureless(scene, seed, site.blank) | _hidden(scene, seed, site.hidden)
    still_open = _open_holes(holes, grid, seed)
    bridged = holes & ~still_open
    return Reconstruction(grid, _bridge(uneven, bridged), bridged, still_open)


def _static_surface(scene: Scene) -> Floats:
    """Return the surface with moving cars lowered and tree crowns closed to a hull."""
    moved = scene.kind == Kind.MOVING_CAR
    ghost = scene.reference + GHOST * (scene.dsm - scene.reference)
    surface = np.where(moved, ghost, scene.dsm)
    leaves = np.isin(scene.kind, (Kind.CROWN, Kind.PLANTS))
    # Gaps between leaves are cells of other kinds; they are closed from above.
    hull = ndimage.median_filter(ndimage.grey_closing(surface, 3), 3)
    hulled: Floats = np.where(ndimage.binary_closing(leaves, iterations=1) | leaves, hull, surface)
    return hulled


def _bumps(grid: Grid, seed: int) -> Floats:
    """Return bumps (m), higher in some areas than in other areas."""
    x, y = np.meshgrid(grid.eastings, grid.northings)
    bumps = field(seed, "bumps", BUMP_WAVES_M, 40)(x, y)
    patchy = np.exp(waves(generator(seed, "matching"), np.geomspace(15, 80, 9), 0.15)(x, y))
    uneven: Floats = BUMPS_M * patchy / np.sqrt(np.mean(patchy**2)) * bumps
    return uneven


def _textureless(scene: Scene, seed: int, share: float) -> Bools:
    """Return the cells of asphalt and flat roofs without matches, ``(H, W)``."""
    south, east = np.gradient(scene.dsm, scene.grid.cell)
    plain = np.isin(scene.kind, TEXTURELESS) & (np.hypot(south, east) < 0.3)
    plain &= scene.reference_road | np.isin(scene.kind, (Kind.PAVED, Kind.BUILDING))
    blank: Bools = plain & _patches(scene.grid, seed, "blank", share)
    return blank


def _hidden(scene: Scene, seed: int, share: float) -> Bools:
    """Return the cells of ground at walls and under eaves that no photograph shows, ``(H, W)``."""
    reach = 2 * round(ALLEY_M / scene.grid.cell) + 1
    near_wall = ndimage.maximum_filter(scene.dsm, reach) - scene.dsm > OVERHEAD_M
    low = scene.dsm - scene.reference < 1
    hidden: Bools = near_wall & low & _patches(scene.grid, seed, "hidden", share)
    return hidden


def _patches(grid: Grid, seed: int, purpose: str, share: float) -> Bools:
    """Return random patches that cover about a fraction ``share`` of the grid, ``(H, W)``."""
    x, y = np.meshgrid(grid.eastings, grid.northings)
    covered: Bools = field(seed, purpose, BLANK_M, 24)(x, y) > -ndtri(share)
    return covered


def _open_holes(holes: Bools, grid: Grid, seed: int) -> Bools:
    """Return the holes that stay open: a fraction of the large ones, ``(H, W)``."""
    numbers: NDArray[np.int32]
    numbers, count = ndimage.label(holes)
    area = np.bincount(numbers.ravel(), minlength=count + 1) * grid.cell**2
    drawn = generator(seed, "open", *map(int, grid.origin)).random(count + 1) < OPEN
    stays_open = drawn & (area > BRIDGED_M2)
    stays_open[0] = False
    cells: Bools = stays_open[numbers]
    return cells


def _bridge(height: Floats, holes: Bools) -> Floats:
    """Return the heights with a smooth surface in the holes, interpolated from their rims."""
    span = float(np.hypot(*height.shape))
    # float32 resolves millimetres only near 0.
    base_m = float(height.mean())
    filled = rasterio.fill.fillnodata(
        (height - base_m).astype(np.float32), ~holes, span, smoothing_iterations=2
    )
    return np.where(holes, filled + base_m, height)


@dataclass(frozen=True, eq=False)
class _PhotogrammetryScene:
    """One synthetic scene: its true surface and its photogrammetric mesh."""

    name: str
    mesh: TexturedMesh
    """One texture, an orthophoto; it is stretched along walls."""
    truth: Scene
    """The scene with cells of 1 m, without noise: ``reference`` is the true ground with bridges,
    ``reference_road`` the true roads, ``road_mask`` the roads with the errors of a segmentation."""
    surface: Scene
    """The scene at the nodes of the lattice, before reconstruction."""
    reconstruction: Reconstruction
    """The reconstructed surface, before simplification."""


def photogrammetry(place: Place, seed: int) -> _PhotogrammetryScene:
    """Make one scene of the replacement for DSC3D.

    - result: equal input gives equal scenes. The mesh fills the square of the place, except for open holes.
    """
    site, grid = place.site, place.grid
    truth = make_scene(grid, seed, site.stratum, place.options)
    surface = make_scene(_nodes(grid), seed, site.stratum, place.options)
    reconstruction = reconstruct(surface, seed, site)
    origin = np.array([grid.west, grid.south, math.floor(reconstruction.height.min())])
    rng = generator(seed, "fragments", *map(int, grid.origin))
    # Random points above the surface, relative to the origin.
    x, y = rng.uniform(0, grid.width * grid.cell, (2, FRAGMENTS))
    height = reconstruction.height[reconstruction.grid.cells(x + origin[0], y + origin[1])]
    centres = np.column_stack([x, y, height - origin[2] + rng.uniform(*FLOATING_M, FRAGMENTS)])
    floating, pieces = fragments(centres, rng)
    east, north = reconstruction.grid.eastings - origin[0], reconstruction.grid.northings - origin[1]
    nodes = lattice(east, north, reconstruction.height - origin[2], reconstruction.open)
    vertices, faces = simplified(*nodes, site.triangles - len(pieces))
    faces = np.concatenate([faces, pieces + np.int32(len(vertices))])
    vertices = np.concatenate([vertices, floating])
    vertices[:, :2] = np.clip(vertices[:, :2], 0, np.array([grid.width, grid.height]) * grid.cell)
    texture = orthophoto(grid, seed, site.stratum, place.options, GSD_M).transpose(1, 2, 0)
    return _PhotogrammetryScene(
        site.name, _textured(vertices, faces, texture, origin, grid), truth, surface, reconstruction
    )


def _nodes(grid: Grid) -> Grid:
    """Return the lattice whose outermost cell centres lie on the edges of a grid."""
    cells = Grid.covering(grid.crs, grid.bounds, NODE_M)
    west, north = grid.west - NODE_M / 2, grid.north + NODE_M / 2
    return Grid(grid.crs, west, north, NODE_M, cells.width + 1, cells.height + 1)


def _textured(
    vertices: Floats, faces: Faces, texture: NDArray[np.uint8], origin: Floats, grid: Grid
) -> TexturedMesh:
    # v increases northwards.
    uv = vertices[:, :2] / (np.array([grid.width, grid.height]) * grid.cell)
    return TexturedMesh(
        crs=grid.crs,
        vertices=vertices + origin,
        faces=faces,
        texture=np.zeros(len(faces), np.int32),
        textures=(np.ascontiguousarray(texture),),
        uv=uv[faces].astype(np.float32),
    )


def encode(mesh: TexturedMesh) -> bytes:
    """Return a mesh with one texture as GLB.

    Vertices are relative to the whole-metre corner of the mesh, in glTF's axes (x east, y up, z south). CRS
    and corner are in the scene's ``extras``, as in FlexRoad's other GLB files. Equal input gives equal bytes.

    - `mesh`: faces that share a vertex must also share its texture coordinates.
    """
    assert mesh.uv is not None
    origin = np.floor(mesh.vertices.min(axis=0))
    east, north, up = (mesh.vertices - origin).T
    uv = np.zeros((len(mesh.vertices), 2), np.float32)
    uv[mesh.faces] = mesh.uv
    material = trimesh.visual.material.PBRMaterial(
        name="orthophoto",
        baseColorTexture=PIL.Image.fromarray(mesh.textures[0]),
        metallicFactor=0.0,
        roughnessFactor=1.0,
    )
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    part = trimesh.Trimesh(np.column_stack([east, up, -north]), mesh.faces, visual=visual, process=False)
    place = {"crs": mesh.crs, "run_origin": [float(value) for value in origin]}
    scene = trimesh.Scene(metadata=place)
    scene.add_geometry(part, node_name="scene", geom_name="scene")
    encoded: bytes = scene.export(file_type="glb")
    return encoded


def lattice(eastings: Floats, northings: Floats, height: Floats, gap: Bools) -> tuple[Floats, Faces]:
    """Return vertices ``(V, 3)`` and faces ``(F, 3)``, two per quad, counter-clockwise from above.

    - `eastings`, `northings`: coordinates of the nodes (m); northings descend.
    - `height`, `gap`: heights of the nodes (m), and nodes in gaps; quads with a node in a gap are left out.
    """
    x, y = np.meshgrid(eastings, northings)
    node = np.arange(height.size, dtype=np.int32).reshape(height.shape)
    nw, sw, se, ne = node[:-1, :-1], node[1:, :-1], node[1:, 1:], node[:-1, 1:]
    quads = np.stack([nw, sw, se, nw, se, ne], axis=-1).reshape(-1, 2, 3)
    complete = ~gap.ravel()[quads].any(axis=(1, 2))
    return np.column_stack([x.ravel(), y.ravel(), height.ravel()]), quads[complete].reshape(-1, 3)


def simplified(vertices: Floats, faces: Faces, triangles: int) -> tuple[Floats, Faces]:
    """Return a mesh with about ``triangles`` triangles, large where the surface is flat.

    Edges are collapsed in the order of their error (quadrics), as in photogrammetry software. Coordinates
    should be small, because they are converted to float32.
    """
    mesh = pv.PolyData.from_regular_faces(vertices, faces).clean()
    if mesh.n_cells > triangles:
        mesh = mesh.decimate(1 - triangles / mesh.n_cells)
    return np.asarray(mesh.points, np.float64), mesh.regular_faces.astype(np.int32)


def fragments(centres: Floats, rng: np.random.Generator) -> tuple[Floats, Faces]:
    """Return small irregular pieces of surface around points ``(n, 3)``, facing up."""
    n = len(centres)
    radius = rng.uniform(*FRAGMENT_M, (n, 1)) * rng.uniform(0.6, 1.4, (n, RIM))
    turn = np.linspace(0, 2 * np.pi, RIM, endpoint=False) + rng.uniform(0, 2 * np.pi, (n, 1))
    tilt = rng.normal(0, 0.3, (n, 1, 2))
    out = np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=-1)
    rise = (out * tilt).sum(axis=-1) + rng.normal(0, 0.1, (n, RIM))
    rim = centres[:, None] + np.concatenate([out, rise[..., None]], axis=-1)
    vertices = np.concatenate([centres[:, None], rim], axis=1).reshape(-1, 3)
    corner = np.arange(RIM)
    fan = np.column_stack([np.zeros(RIM, np.int64), 1 + corner, 1 + (corner + 1) % RIM])
    faces = fan + (RIM + 1) * np.arange(n)[:, None, None]
    return vertices, faces.reshape(-1, 3).astype(np.int32)
