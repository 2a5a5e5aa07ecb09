"""Open exports of real data in other programs, and compare the heights there with queries of the run.

Usage: FLEXROAD_VALIDATORS=.validators python -m tests.validators.reopen DATA [FOLDER]

``DATA`` is the folder of real data (``FLEXROAD_REAL_DATA`` of the tests); runs and exports are written to
``FOLDER``, by default ``runs/reopened``, and are kept: a second call uses them. The script prints one table,
and exits with 1 if a height differs by more than the export has printed, in its manifest or in ``roads.csv``.

Programs that are missing are named and left out. Blender and QGIS are no part of ``make validators``:
``BPY_PYTHON`` and ``QGIS_PYTHON`` name interpreters that have ``bpy`` (``pip install bpy``) and ``qgis``
(Debian's ``python3-qgis``); without them the packages of the validators and of the system are tried.
"""

import json
import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

import geopandas
import numpy as np
import pyogrio
import pyopencrg
import rasterio
import scipy
import shapely
import trimesh

import flexroad
from flexroad.tools.export.source import select
from tests import validators
from tests.read_exports import OFFSET_M, spline_heights
from tests.real.streets import STREETS
from tests.validators.opencascade import read_step
from tests.validators.opendrive import by_carla, by_sumo, in_crs, printed_mm

HERE = Path(__file__).parent
FLEXROAD = Path(sys.executable).with_name("flexroad")
FORMATS = "3dtiles,landxml,obj,step,mosaic,crg,xodr,lines"
ROADS = "class = 'road' AND certainty <> 'low' AND visible_in IS NOT 'rgb'"
SURFACE, SMOOTH, MESH = "query", "query without steps", "mesh of the run"
"""What heights are compared with: `RunView.height`, the same without kerbs and walls, or vertices."""
SAME_M = 0.001
"""Distance from a vertex of the run within which files have it (m)."""
RNG_SEED = 0


@dataclass(frozen=True)
class Found:
    """Heights that a program has read from a file."""

    version: str
    file: str
    against: str
    """`SURFACE`, `SMOOTH` or `MESH`."""
    difference_mm: np.ndarray
    """``(n,)``; NaN beyond the survey."""
    printed_mm: np.ndarray
    """What the export has printed for each of them."""

    @property
    def known(self) -> np.ndarray:
        """Whether a point lies on the survey."""
        return np.isfinite(self.difference_mm)

    @property
    def holds(self) -> bool:
        """Whether no point is farther off than printed, and most points can be compared."""
        return bool(self.known.mean() > 0.9 and (self.difference_mm <= self.printed_mm)[self.known].all())


@dataclass(frozen=True)
class Survey:
    """A run of real data, and its export in all formats."""

    name: str
    folder: Path

    @property
    def run(self) -> Path:
        """Its folder of results."""
        return self.folder / "run"

    @property
    def out(self) -> Path:
        """Its folder of exports."""
        return self.folder / "out"

    @cached_property
    def manifest(self) -> dict[str, Any]:
        """The content of ``export.json``."""
        return json.loads((self.out / "export.json").read_text())

    def files(self, pattern: str) -> list[Path]:
        """Return files of the export, of which there is at least one."""
        found = sorted(self.out.glob(pattern))
        assert found, f"{self.out / pattern}: no file"
        return found

    def heights(self, against: str, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the heights that are true (m); NaN beyond the survey."""
        height = flexroad.open_run(self.run).height(x, y)
        if against == SMOOTH:
            height = np.where(np.isfinite(height), spline_heights(self.run, np.column_stack([x, y])), np.nan)
        return height

    def compare(self, program: str, file: str, against: str, points: np.ndarray, printed: Any) -> Found:
        """Return how far points, ``(n, 3)``, are from the surface; ``printed`` is in metres."""
        difference = 1000 * np.abs(points[:, 2] - self.heights(against, points[:, 0], points[:, 1]))
        return Found(
            program, file, against, difference, np.broadcast_to(1000 * np.array(printed), difference.shape)
        )

    @cached_property
    def mesh_vertices(self) -> np.ndarray:
        """The vertices of the run's meshes, ``(n, 3)``."""
        return np.concatenate([tile.mesh.vertices + tile.mesh.origin for tile in select(self.run).finished()])

    def vertices(self, program: str, file: str, points: np.ndarray, printed: float) -> Found:
        """Return how far vertices are above or below the run's meshes, which must all be there."""
        away, nearest = scipy.spatial.KDTree(points).query(self.mesh_vertices)
        difference = 1000 * np.abs(points[nearest, 2] - self.mesh_vertices[:, 2])
        difference[away > SAME_M] = np.inf
        return Found(program, file, MESH, difference, np.full(len(difference), 1000 * printed))


def carla(survey: Survey, _: Path) -> Iterator[Found]:
    """OpenDRIVE, by elevation alone."""
    (file,) = survey.files("xodr/*.xodr")
    yield from _roads(survey, "0.9.16", file, *by_carla(file))


def sumo(survey: Survey, scratch: Path) -> Iterator[Found]:
    """OpenDRIVE, by elevation alone."""
    (file,) = survey.files("xodr/*.xodr")
    text = subprocess.run(
        [validators.program("netconvert"), "--version"], capture_output=True, text=True, check=True
    )
    yield from _roads(survey, text.stdout.split()[3], file, *by_sumo(file, scratch))


def _roads(
    survey: Survey, program: str, file: Path, roads: np.ndarray, places: np.ndarray
) -> Iterator[Found]:
    x, y = in_crs(file, survey.manifest["crs"], *places[:, :2].T)
    points = np.column_stack([x, y, places[:, 2]])
    for against, columns in (
        (SMOOTH, ["elevation_max_mm"]),
        (SURFACE, ["elevation_max_mm", "carriageway_steps_max_mm"]),
    ):
        printed = printed_mm(file.with_name("roads.csv"), *columns)
        yield survey.compare(program, "xodr", against, points, [printed[road] / 1000 for road in roads])


def opencrg(survey: Survey, _: Path) -> Iterator[Found]:
    """OpenCRG at CARLA's places on the lanes: the plan of both files is the same."""
    (file,) = survey.files("xodr/*.xodr")
    roads, places = by_carla(file)
    printed = {
        SMOOTH: printed_mm(file.with_name("roads.csv"), "crg_max_mm"),
        SURFACE: printed_mm(file.with_name("roads.csv"), "crg_max_mm", "crg_steps_max_mm"),
    }
    x, y = in_crs(file, survey.manifest["crs"], *places[:, :2].T)
    height, along = np.empty(len(x)), np.zeros(len(x), bool)
    for road in np.unique(roads):
        here = roads == road
        grid = pyopencrg.CrgRoad.read(survey.out / "crg" / f"{road}.crg")
        height[here] = grid.xy_to_z(*places[here, :2].T)
        # Beyond the ends of a road the last heights are repeated.
        along[here] = [grid.u_start < grid.xy_to_uv(*place)[0] < grid.u_end for place in places[here, :2]]
    points = np.column_stack([x, y, height])[along]
    for against, errors in printed.items():
        of_roads = [errors[road] / 1000 for road in roads[along]]
        yield survey.compare(version("pyopencrg"), "crg", against, points, of_roads)


def _precision(survey: Survey, name: str) -> float:
    return float(survey.manifest["formats"][name]["precision_m"])


def blender(survey: Survey, _: Path) -> Iterator[Found]:
    """OBJ with Blender's settings of the documentation, and the GLB of the run."""
    python = interpreter("bpy")
    origin = np.array(json.loads(survey.files("obj/*.json")[0].read_text())["origin"])
    for name, files in (
        ("obj", survey.files("obj/*.obj")),
        ("3dtiles", sorted(survey.run.glob("tiles/*/*.glb"))),
    ):
        done = subprocess.run(
            [python, HERE / "read_blender.py", *files], capture_output=True, text=True, check=True
        )
        read = json.loads(done.stdout)
        points = np.concatenate([np.array(part) for part in read["vertices"]]) + origin
        yield survey.vertices(
            read["version"], "obj" if name == "obj" else "GLB", points, _precision(survey, name)
        )


def trimesh_(survey: Survey, _: Path) -> Iterator[Found]:
    """OBJ, its place from the JSON file beside it."""
    parts = []
    for file in survey.files("obj/*.obj"):
        mesh = trimesh.load(file, process=False, force="mesh")
        parts.append(mesh.vertices + json.loads(file.with_suffix(".json").read_text())["origin"])
    yield survey.vertices(trimesh.__version__, "obj", np.concatenate(parts), _precision(survey, "obj"))


def opencascade(survey: Survey, _: Path) -> Iterator[Found]:
    """STEP, on a lattice over each tile."""
    parts = []
    for file in survey.files("step/*.stp"):
        valid, points = read_step(file, 30)
        assert valid, f"{file}: OpenCASCADE finds it invalid"
        parts.append(points + json.loads(file.with_name(f"{file.stem}_stp.json").read_text())["origin"])
    yield from _cad(survey, "8.0.1", "step", np.concatenate(parts))


def _cad(survey: Survey, program: str, name: str, points: np.ndarray) -> Iterator[Found]:
    known = np.isfinite(survey.heights(SURFACE, *points[:, :2].T))
    precision, steps = _precision(survey, name), survey.manifest["formats"][name]["steps_max_m"]
    yield survey.compare(program, name, SMOOTH, points[known], precision)
    yield survey.compare(program, name, SURFACE, points[known], precision + steps)


def qgis(survey: Survey, _: Path) -> Iterator[Found]:
    """The mosaic at centres of cells, and road lines."""
    python = interpreter("qgis")
    (lines,), (raster,) = survey.files("lines/*.gpkg"), survey.files("mosaic/height.tif")
    places = _cells(raster)[:, :2]
    command = [python, HERE / "read_qgis.py", raster, lines, "roads"]
    given = json.dumps(places.tolist())
    done = subprocess.run(command, input=given, capture_output=True, text=True, check=True, env=_clean())
    read = json.loads(done.stdout)
    assert read["classes"] == ["No road, or road that the filter removed", "Road that the surface follows"]
    points = np.column_stack([places, np.array(read["heights"], float)])
    yield survey.compare(read["version"], "mosaic", SURFACE, points, _precision(survey, "mosaic"))
    yield from _lines(survey, read["version"], np.array(read["vertices"]))


def gdal(survey: Survey, _: Path) -> Iterator[Found]:
    """The mosaic at centres of cells, and road lines, by rasterio and pyogrio."""
    (lines,), (raster,) = survey.files("lines/*.gpkg"), survey.files("mosaic/height.tif")
    points = _cells(raster)
    yield survey.compare(rasterio.__gdal_version__, "mosaic", SURFACE, points, _precision(survey, "mosaic"))
    vertices = shapely.get_coordinates(pyogrio.read_dataframe(lines, layer="roads").geometry, include_z=True)
    yield from _lines(survey, pyogrio.__gdal_version_string__, vertices)


def _cells(raster: Path) -> np.ndarray:
    """Return centres and heights of cells of a raster that have a height."""
    with rasterio.open(raster) as file:
        heights = file.read(1, masked=True)
        rows, columns = np.nonzero(~np.ma.getmaskarray(heights))
        chosen = np.random.default_rng(RNG_SEED).choice(len(rows), 20_000, replace=False)
        rows, columns = rows[chosen], columns[chosen]
        x, y = file.xy(rows, columns)
    return np.column_stack([x, y, heights[rows, columns]])


def _lines(survey: Survey, program: str, vertices: np.ndarray) -> Iterator[Found]:
    # GeoPackage has doubles, and heights along lines are rounded to 0.1 mm.
    yield survey.compare(program, "lines", SMOOTH, vertices, 1e-4)
    steps = survey.manifest["formats"]["lines"]["steps_max_m"]
    yield survey.compare(program, "lines", SURFACE, vertices, 1e-4 + steps)


PROGRAMS: dict[str, tuple[str, Callable[[Survey, Path], Iterator[Found]]]] = {
    "CARLA": ("carla", carla),
    "SUMO": ("sumo", sumo),
    "PyOpenCRG": ("carla", opencrg),
    "Blender": ("bpy", blender),
    "trimesh": ("", trimesh_),
    "OpenCASCADE": ("OCP", opencascade),
    "QGIS": ("qgis", qgis),
    "GDAL": ("", gdal),
}
"""What opens files, and the module that another interpreter needs for it; empty for modules of the tests."""


def interpreter(module: str) -> Path | None:
    """Return an interpreter that has a module: named by a variable, the validators' or the system's."""
    named = os.environ.get(f"{module.upper()}_PYTHON")
    for python in (named, f"{os.environ.get('FLEXROAD_VALIDATORS')}/bin/python", "/usr/bin/python3"):
        if python and Path(python).exists():
            command = [python, "-c", f"import {module}"]
            if subprocess.run(command, capture_output=True, env=_clean(), check=False).returncode == 0:
                return Path(python).absolute()
    return None


def _clean() -> dict[str, str]:
    """Return the environment without variables of this interpreter's GDAL and PROJ."""
    own = ("PROJ_DATA", "PROJ_LIB", "GDAL_DATA")
    return {key: value for key, value in os.environ.items() if key not in own}


def _flexroad(folder: Path, *words: object) -> None:
    """Run a command in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    subprocess.run([FLEXROAD, *map(str, words)], cwd=folder, check=True)


def barbican(data: Path, folder: Path) -> Survey:
    """Return the Barbican, London, with four streets."""
    survey = Survey("Barbican", folder / "barbican")
    if not (survey.folder / "catalog.parquet").exists():
        with zipfile.ZipFile(data / "umep" / "London_BNG.zip") as archive:
            archive.extractall(survey.folder)
        layers = [
            "--dsm",
            "dsm_*.tif",
            "--dtm",
            "dem_*.tif",
            "--road-mask",
            "landcover_*.tif",
            "--road-value",
            1,
        ]
        _flexroad(survey.folder, "catalog", "rasters", "London_BNG", *layers, "-o", "catalog.parquet")
        lines = [shapely.LineString(places) for places in STREETS.values()]
        columns = {"name": list(STREETS), "width": 9.0, "lanes": 2}
        frame = geopandas.GeoDataFrame(columns, geometry=lines, crs="EPSG:27700")
        frame.to_file(survey.folder / "streets.gpkg")
    return _exported(survey, "--roads", "streets.gpkg", "--left-hand")


def autzen(data: Path, folder: Path) -> Survey:
    """Return the north of the Autzen survey, with its centre lines."""
    survey, roads = Survey("Autzen", folder / "autzen"), data / "autzen" / "roads" / "autzen_north_roads.gpkg"
    if not (survey.folder / "catalog.parquet").exists():
        layer = ["--roads", f"{roads}|layername=road_polygons", "--roads-where", ROADS]
        points = data / "autzen" / "autzen_north.laz"
        _flexroad(survey.folder, "prepare", points, "--crs", "EPSG:2994", *layer, "-o", ".")
    return _exported(survey, "--drape", "--roads", f"{roads}|layername=road_centerlines")


def _exported(survey: Survey, *options: object) -> Survey:
    """Run and export a survey."""
    _flexroad(survey.folder, "run", "--catalog", "catalog.parquet", "--out", "run")
    formats = ["--format", FORMATS, "--vertical", OFFSET_M, *options]
    _flexroad(survey.folder, "export", "run", *formats, "-o", "out")
    return survey


def main(data: str, folder: str = "runs/reopened") -> int:
    """Print the table; return the exit code."""
    where = Path(folder).absolute()
    surveys = [make(Path(data).absolute(), where) for make in (autzen, barbican)]
    scratch = where / "scratch"
    scratch.mkdir(exist_ok=True)
    print("| program | data | file | compared with | points | largest difference (mm) | printed (mm) | |")
    print("| --- | --- | --- | --- | ---: | ---: | ---: | --- |")
    failed, missing = False, []
    for name, (module, read) in PROGRAMS.items():
        if module and interpreter(module) is None:
            missing.append(f"left out: {name}: no interpreter has the module {module}")
            continue
        for survey in surveys:
            for found in read(survey, scratch):
                failed |= not found.holds
                print(_line(name, survey, found), flush=True)
    print(*missing, sep="\n")
    shutil.rmtree(scratch)
    return int(failed)


def _line(name: str, survey: Survey, found: Found) -> str:
    """Return a row of the table; the printed error is the largest one of the file."""
    known = found.known
    cells = [
        f"{name} {found.version}",
        survey.name,
        found.file,
        found.against,
        f"{known.sum():,}",
        f"{found.difference_mm[known].max():,.4g}",
        f"{found.printed_mm[known].max():,.4g}",
        "ok" if found.holds else "**more than printed**",
    ]
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
