"""The surface of a tile as STEP file (ISO 10303-21, AP214) with one B-spline surface, for CAD programs.

The file has the surface itself and no triangles: an open shell of one face, bounded by its four border
curves, in metres. It is cut to the given bounds by knot insertion, which is exact. With equal weights the
surface is a polynomial spline of the same degree; else it is rational (`tasks.spline.surface.exact`).
Plan coordinates are relative to a whole-metre origin that all tiles of a run share; z is the height.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime

import numpy as np

from flexroad.catalog.grid import Bounds, overlap
from flexroad.catalog.text import edges
from flexroad.tasks.errors import TaskError
from flexroad.tasks.spline.surface import ExactNurbs, NurbsSurface, domain, exact
from flexroad.tasks.types import Floats, RoadMask
from flexroad.tools.export.georeference import Georeference

VERSION = 3
NAME = ".stp"
NAME_SIDECAR = "_stp.json"

AXES = "x east, y north, relative to origin; z height; metres"
LONGEST = 250
"""Longest text of an entry of the head (characters); the standard allows 256."""

FILE = """\
ISO-10303-21;
HEADER;
FILE_DESCRIPTION({description},'2;1');
FILE_NAME({name},'{written:%Y-%m-%dT%H:%M:%S}',(''),(''),'FlexRoad','FlexRoad','');
FILE_SCHEMA(('AUTOMOTIVE_DESIGN {{ 1 0 10303 214 1 1 1 1 }}'));
ENDSEC;
DATA;
{data}ENDSEC;
END-ISO-10303-21;
"""

Knots = tuple[Sequence[int], Sequence[float]]
"""Multiplicities and values of the different knots."""
SAME_KNOT = 4e-12
"""Parameters closer than this share of the domain are one knot: 1 nm over 250 m, for rounded northings."""


def encode(surface: NurbsSurface, bounds: Bounds, name: str, written: datetime, place: Georeference) -> bytes:
    """Return the part of a surface within bounds as a STEP file.

    Coordinates have all digits of their float64 numbers. Equal inputs give equal bytes.

    - `bounds`: west, south, east and north of the part, such as the tile's core (m). The part ends where the
      domain of the surface ends.
    - `place`: origin of the coordinates; its height is 0.
    """
    nurbs, rational = patch(surface, bounds, place.origin[:2])
    lines = [f"FlexRoad surface {name}", f"axes {AXES}", *place.lines()]
    cut = [line[k : k + LONGEST] for line in lines for k in range(0, len(line), LONGEST)]
    content = FILE.format(
        description=_list(map(_text, cut)),
        name=_text(name),
        written=written,
        data=_Data(rational).shape(nurbs, name),
    )
    return content.encode("ascii")


@dataclass
class _Data:
    """The entities of a file, numbered in the order in which they are added."""

    rational: bool
    entities: list[str] = field(default_factory=list)

    def add(self, entity: str) -> str:
        """Add an entity; return its reference."""
        self.entities.append(entity)
        return f"#{len(self.entities)}"

    def shape(self, nurbs: ExactNurbs, name: str) -> str:
        """Return all entities of a product whose shape is a face on a surface."""
        add = self.add
        definition, context = self.product(name), self.units()
        place = add("CARTESIAN_POINT('',(0.,0.,0.))")
        up, east = add("DIRECTION('',(0.,0.,1.))"), add("DIRECTION('',(1.,0.,0.))")
        axes = add(f"AXIS2_PLACEMENT_3D('',{place},{up},{east})")
        face = self.face(nurbs)
        shell = add(f"OPEN_SHELL('',({face}))")
        model = add(f"SHELL_BASED_SURFACE_MODEL({_text(name)},({shell}))")
        shape = add(f"MANIFOLD_SURFACE_SHAPE_REPRESENTATION({_text(name)},({axes},{model}),{context})")
        add(f"SHAPE_DEFINITION_REPRESENTATION({definition},{shape})")
        return "".join(f"#{number}={entity};\n" for number, entity in enumerate(self.entities, 1))

    def product(self, name: str) -> str:
        """Add a product; return the definition of its shape."""
        add, label = self.add, _text(name)
        application = add("APPLICATION_CONTEXT('automotive design')")
        year = f"'automotive_design',2000,{application}"
        add(f"APPLICATION_PROTOCOL_DEFINITION('international standard',{year})")
        context = add(f"PRODUCT_CONTEXT('',{application},'mechanical')")
        product = add(f"PRODUCT({label},{label},'',({context}))")
        add(f"PRODUCT_RELATED_PRODUCT_CATEGORY('part',$,({product}))")
        formation = add(f"PRODUCT_DEFINITION_FORMATION('','',{product})")
        stage = add(f"PRODUCT_DEFINITION_CONTEXT('part definition',{application},'design')")
        definition = add(f"PRODUCT_DEFINITION('design','',{formation},{stage})")
        return add(f"PRODUCT_DEFINITION_SHAPE('','',{definition})")

    def units(self) -> str:
        """Add metres and radians; return the context of coordinates."""
        add = self.add
        metre = add("(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT($,.METRE.))")
        radian = add("(NAMED_UNIT(*)PLANE_ANGLE_UNIT()SI_UNIT($,.RADIAN.))")
        steradian = add("(NAMED_UNIT(*)SI_UNIT($,.STERADIAN.)SOLID_ANGLE_UNIT())")
        accuracy = add(
            f"UNCERTAINTY_MEASURE_WITH_UNIT(LENGTH_MEASURE(1.E-6),{metre},'distance_accuracy_value','')"
        )
        return add(
            f"(GEOMETRIC_REPRESENTATION_CONTEXT(3)GLOBAL_UNCERTAINTY_ASSIGNED_CONTEXT(({accuracy}))"
            f"GLOBAL_UNIT_ASSIGNED_CONTEXT(({metre},{radian},{steradian}))REPRESENTATION_CONTEXT('',''))"
        )

    def face(self, nurbs: ExactNurbs) -> str:
        """Add a surface with its four borders; return the face.

        The borders run from west to east and from south to north. The loop is counter-clockwise from above,
        so it follows the northern and the western border backwards.
        """
        add, (p, q) = self.add, nurbs.degree
        knots_u, knots_v = _distinct(nurbs.knots_u), _distinct(nurbs.knots_v)
        weights = nurbs.points[..., 3]
        points = [
            [add(f"CARTESIAN_POINT('',{_reals(each[:3].tolist())})") for each in row] for row in nurbs.points
        ]
        vertices = {
            (row, col): add(f"VERTEX_POINT('',{points[row][col]})") for row in (0, -1) for col in (0, -1)
        }
        south, north = (
            self.edge(vertices[row, 0], vertices[row, -1], p, knots_u, points[row], weights[row])
            for row in (0, -1)
        )
        west, east = (
            self.edge(
                vertices[0, col], vertices[-1, col], q, knots_v, [row[col] for row in points], weights[:, col]
            )
            for col in (0, -1)
        )
        turns = ((south, ".T."), (east, ".T."), (north, ".F."), (west, ".F."))
        edges = [add(f"ORIENTED_EDGE('',*,*,{edge},{along})") for edge, along in turns]
        loop = add(f"EDGE_LOOP('',{_list(edges)})")
        bound = add(f"FACE_OUTER_BOUND('',{loop},.T.)")
        surface = self.surface((p, q), knots_u, knots_v, points, weights)
        return add(f"ADVANCED_FACE('',({bound}),{surface},.T.)")

    def edge(
        self, start: str, end: str, degree: int, knots: Knots, points: Sequence[str], weights: Floats
    ) -> str:
        """Add a border of the surface."""
        shape, form = f"{degree},{_list(points)},.UNSPECIFIED.,.F.,.F.", _knots(knots)
        if self.rational:
            curve = self.add(
                f"(BOUNDED_CURVE()B_SPLINE_CURVE({shape})B_SPLINE_CURVE_WITH_KNOTS({form})CURVE()"
                f"GEOMETRIC_REPRESENTATION_ITEM()RATIONAL_B_SPLINE_CURVE({_reals(weights.tolist())})"
                "REPRESENTATION_ITEM(''))"
            )
        else:
            curve = self.add(f"B_SPLINE_CURVE_WITH_KNOTS('',{shape},{form})")
        return self.add(f"EDGE_CURVE('',{start},{end},{curve},.T.)")

    def surface(
        self,
        degree: tuple[int, int],
        knots_u: Knots,
        knots_v: Knots,
        points: Sequence[Sequence[str]],
        weights: Floats,
    ) -> str:
        """Add the surface. In STEP the first index is along u, in the arrays along v."""
        columns = _list(_list(column) for column in zip(*points, strict=True))
        shape = f"{degree[0]},{degree[1]},{columns},.UNSPECIFIED.,.F.,.F.,.F."
        form = _knots(knots_u, knots_v)
        if self.rational:
            return self.add(
                f"(BOUNDED_SURFACE()B_SPLINE_SURFACE({shape})B_SPLINE_SURFACE_WITH_KNOTS({form})"
                f"GEOMETRIC_REPRESENTATION_ITEM()"
                f"RATIONAL_B_SPLINE_SURFACE({_list(_reals(column) for column in weights.T.tolist())})"
                "REPRESENTATION_ITEM('')SURFACE())"
            )
        return self.add(f"B_SPLINE_SURFACE_WITH_KNOTS('',{shape},{form})")


def _distinct(knots: Floats) -> Knots:
    values, counts = np.unique(knots, return_counts=True)
    return counts.tolist(), values.tolist()


def _knots(*knots: Knots) -> str:
    """Return the arguments of a spline from its multiplicities on, for one or two parameters."""
    multiplicities = [_list(map(str, counts)) for counts, _ in knots]
    return ",".join([*multiplicities, *(_reals(values) for _, values in knots), ".UNSPECIFIED."])


def _list(items: Iterable[str]) -> str:
    return f"({','.join(items)})"


def _reals(values: Iterable[float]) -> str:
    return _list(map(_real, values))


def _real(value: float) -> str:
    """Return a number in the standard's form: with a decimal point, and an upper-case E."""
    mantissa, mark, exponent = repr(float(value)).partition("e")
    return mantissa + ("" if "." in mantissa else ".") + mark.upper() + exponent


def _text(text: str) -> str:
    r"""Return a string of the standard: quotes and backslashes doubled, other characters as ``\X4\``."""
    return "'" + "".join(map(_character, text)) + "'"


def _character(character: str) -> str:
    if character in "'\\":
        return 2 * character
    return character if " " <= character <= "~" else f"\\X4\\{ord(character):08X}\\X0\\"


def cut(surface: NurbsSurface, bounds: Bounds) -> NurbsSurface:
    """Return the part of a surface within bounds, with clamped knots from 0 to 1; the cut is exact.

    The part ends where the domain of the surface ends. Beyond it the surface is extrapolated, which a spline
    on these knots cannot express.
    """
    if not overlap(surface.bounds, bounds):
        raise TaskError(
            f"bounds {edges(bounds)} lie beyond the surface's domain {edges(surface.bounds)}; choose others"
        )
    west, south = np.maximum(surface.bounds[:2], bounds[:2]).tolist()
    east, north = np.minimum(surface.bounds[2:], bounds[2:]).tolist()
    (p, q), whole = surface.degree, surface.bounds
    knots_u, along_u = _part(surface.knots_u, p, (west - whole[0], east - whole[0]), whole[2] - whole[0])
    knots_v, along_v = _part(surface.knots_v, q, (south - whole[1], north - whole[1]), whole[3] - whole[1])
    return replace(
        surface,
        bounds=(west, south, east, north),
        knots_u=knots_u,
        knots_v=knots_v,
        A=along_v @ surface.A @ along_u.T,
        W=along_v @ surface.W @ along_u.T,
    )


def covered(road: RoadMask) -> tuple[Bounds, float]:
    """Return the smallest rectangle around all covered cells of a tile, and its area beyond the survey.

    - `bounds`: west, south, east and north (m); the bounds of the core if no cell is covered.
    - `beyond_m2`: area within the bounds that is beyond the survey (m2).
    """
    core, inside = road.core, ~road.outside[road.grid.window(road.core)]
    if inside.all() or not inside.any():
        return core.bounds, float((~inside).sum() * core.cell**2)
    rows, cols = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
    top, bottom, left, right = rows[0], rows[-1] + 1, cols[0], cols[-1] + 1
    west, north = core.bounds[0], core.bounds[3]
    bounds = (
        float(west + left * core.cell),
        float(north - bottom * core.cell),
        float(west + right * core.cell),
        float(north - top * core.cell),
    )
    return bounds, float((~inside[top:bottom, left:right]).sum() * core.cell**2)


def patch(surface: NurbsSurface, bounds: Bounds, origin: tuple[float, float]) -> tuple[ExactNurbs, bool]:
    """Return the exact part of a surface within bounds as a NURBS with control points in space.

    - `origin`: easting and northing that the control points are relative to (m).
    - `patch`: if all weights are equal, it has the surface's degree and weights 1; else the form of `exact`.
    - `rational`: whether the weights differ.
    """
    part = replace(cut(surface, bounds), origin=origin)
    if np.ptp(surface.W):
        return exact(part), True
    points = part.control_points - np.array([*part.origin, 0, 0])
    points[..., 3] = 1
    return ExactNurbs(part.degree, part.knots_u, part.knots_v, points, part.origin), False


def _part(knots: Floats, degree: int, ends: tuple[float, float], length: float) -> tuple[Floats, Floats]:
    """Return clamped knots on [0, 1] of a part, and the matrix from all control points to the part's.

    The ends are distances from the start of the domain, whose length is given in the same unit.
    """
    low, high = domain(knots, degree)
    first, last = (_knot(knots, low + end * (high - low) / length, high - low) for end in ends)
    points = np.eye(len(knots) - degree - 1)
    for end in (first, last):
        for _ in range(degree - np.count_nonzero(knots == end)):
            knots, points = _inserted(knots, points, degree, end)
    inner = knots[(knots > first) & (knots < last)]
    start = int(np.searchsorted(knots, first, side="right")) - 1 - degree
    clamped = np.concatenate([np.full(degree + 1, first), inner, np.full(degree + 1, last)])
    return (clamped - first) / (last - first), points[start : start + len(inner) + degree + 1]


def _knot(knots: Floats, parameter: float, length: float) -> float:
    """Return the knot at a parameter if there is one, else the parameter."""
    nearest = float(knots[np.argmin(np.abs(knots - parameter))])
    return nearest if abs(nearest - parameter) <= SAME_KNOT * length else parameter


def _inserted(knots: Floats, points: Floats, degree: int, new: float) -> tuple[Floats, Floats]:
    """Insert a knot; return the knots, and the control points that leave the spline unchanged (Boehm)."""
    span = int(np.searchsorted(knots, new, side="right")) - 1
    i = np.arange(span - degree + 1, span - np.count_nonzero(knots == new) + 1)
    share = ((new - knots[i]) / (knots[i + degree] - knots[i]))[:, None]
    between = share * points[i] + (1 - share) * points[i - 1]
    return np.insert(knots, span + 1, new), np.concatenate([points[: i[0]], between, points[i[-1] :]])
