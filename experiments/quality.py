"""Compare the error estimate with the true road L2, and check that deliberate faults are flagged.

``PYTHONPATH=. python experiments/quality.py 48 1`` for 48 tiles of seed 1, as in docs/archive/quality.md;
without arguments 12 tiles are used.
"""

import sys
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pandas as pd
from scipy.ndimage import gaussian_filter, label

from flexroad.catalog.grid import Grid
from flexroad.tasks.filter import ecsrc
from flexroad.tasks.fit import nurbs
from flexroad.tasks.quality.assess import Options, assess
from flexroad.tasks.roads.dtm_validity import invalid_dtm, without_invalid_dtm
from flexroad.tasks.spline.surface import NurbsSurface
from flexroad.tasks.synthetic import make_scene
from flexroad.tasks.synthetic.gerod import survey
from flexroad.tasks.synthetic.spoilers import Kind
from flexroad.tasks.types import Bools, Floats, Quality, RoadClusters, RoadMask, Surface, TileData

SPOILED_M = 0.3
FREE, UNIT = nurbs.Options(), nurbs.Options(weights="unit")
CROWN, HOLE = 9, 40
"""Radius of a crown over the road, and side of a square without data, in cells."""


def degraded(dtm: Floats, rng: np.random.Generator) -> Floats:
    """Return a DTM with 0.1 m of noise and 25 scars of 14 x 18 cells, 0.8 m deep or high (deviations)."""
    grain = gaussian_filter(rng.standard_normal(dtm.shape), 2)
    out: Floats = dtm + 0.1 * grain / grain.std()
    for row, col in rng.integers(0, dtm.shape[0], (25, 2)):
        out[row : row + 14, col : col + 18] += rng.normal(0, 0.8)
    return out


def near_dtm(data: TileData, road: RoadMask) -> RoadClusters:
    """Keep the cells within 0.3 m of the DTM: the simplest filter that keeps no objects."""
    return RoadClusters(data.grid, (road.mask & (np.abs(data.dsm - data.dtm) <= 0.3)).astype(np.int32))


def chains(data: TileData, road: RoadMask) -> Iterator[tuple[str, RoadClusters, Surface]]:
    """Yield name, clusters and surface of several combinations of filter and fit."""
    paper, near = ecsrc.ecsrc(data, road, ecsrc.Options()), near_dtm(data, road)
    yield "paper", paper, nurbs.fit(data, paper, FREE)
    yield "paper, unit weights", paper, nurbs.fit(data, paper, UNIT)
    yield "near the DTM", near, nurbs.fit(data, near, UNIT)
    checked = replace(near, dtm_invalid=invalid_dtm(data, road, near.mask))
    yield (
        "near the DTM, invalid DTM left out",
        checked,
        nurbs.fit(without_invalid_dtm(data, checked), checked, UNIT),
    )


def faults(
    data: TileData, road: RoadMask, rng: np.random.Generator
) -> Iterator[tuple[str, TileData, RoadClusters, Surface]]:
    """Yield the same tile with one fault at a time."""
    near = near_dtm(data, road)
    surface = nurbs.fit(data, near, UNIT)
    yield "none", data, near, surface
    row, col = rng.choice(np.argwhere(near.mask[15:-15, 15:-15])) + 15
    yield "pole", data, near, _pole(surface, row, col, data.grid)
    disc = np.hypot(*(np.indices(data.grid.shape) - np.array([[[row]], [[col]]]))) < CROWN
    crown = replace(data, dsm=data.dsm + disc * (4 + rng.uniform(-2, 2, data.grid.shape)))
    with_crown_cells = replace(near, labels=np.where(disc & road.mask, 1, near.labels).astype(np.int32))
    yield "crown kept", crown, with_crown_cells, nurbs.fit(crown, with_crown_cells, UNIT)
    hole = np.zeros(data.grid.shape, np.bool_)
    row, col = np.clip((row, col), HOLE // 2, data.grid.height - HOLE // 2)
    hole[row - HOLE // 2 : row + HOLE // 2, col - HOLE // 2 : col + HOLE // 2] = True
    without_data = replace(data, dsm=np.where(hole, np.nan, data.dsm), dtm=np.where(hole, np.nan, data.dtm))
    kept = near_dtm(without_data, road)
    yield "no data", without_data, kept, nurbs.fit(without_data, kept, UNIT)


def _pole(surface: NurbsSurface, row: int, col: int, grid: Grid) -> NurbsSurface:
    """Lift the control point nearest to a cell by 3 m."""
    lifted = surface.A.copy()
    points, (m, n) = surface.control_points, surface.A.shape
    flat = np.hypot(points[..., 0] - grid.eastings[col], points[..., 1] - grid.northings[row]).argmin()
    lifted[np.unravel_index(flat, (m, n))] += 3
    return replace(surface, A=lifted)


def row_of(quality: Quality, surface: Surface, data: TileData, hidden: Bools) -> dict[str, object]:
    """Return the quality figures of a surface and its true errors."""
    assert data.reference is not None
    assert data.reference_road is not None
    errors = np.abs(surface.lattice(data.grid.eastings, data.grid.northings) - data.reference)
    on_road = errors[data.reference_road]
    true = {"l2": on_road.mean(), "spoiled": (on_road > SPOILED_M).mean(), "hidden": errors[hidden].mean()}
    figures = {name: getattr(quality, name) for name in Quality.__annotations__ if name != "support"}
    return true | figures


def main(tiles: int, seed: int) -> None:
    """Print both tables."""
    rows, fault_rows = [], []
    for tile_id, grid, stratum, options in survey(tiles, seed):
        scene = make_scene(grid, seed, stratum, options)
        road = RoadMask(grid, grid, scene.road_mask, np.zeros(grid.shape, np.bool_))
        data = TileData(
            tile_id, grid, grid, scene.dsm, scene.dtm, None, scene.reference, scene.reference_road
        )
        rng = np.random.default_rng([seed, len(rows)])
        hidden = scene.reference_road & road.mask & (scene.kind == Kind.CROWN)
        for dtm, tile_data in (("as made", data), ("degraded", replace(data, dtm=degraded(data.dtm, rng)))):
            for name, clusters, surface in chains(tile_data, road):
                quality = assess(tile_data, road, clusters, surface, Options())
                rows.append({"dtm": dtm, "chain": name} | row_of(quality, surface, tile_data, hidden))
        for name, tile_data, clusters, surface in faults(data, road, rng):
            flags = assess(tile_data, road, clusters, surface, Options()).flags
            fault_rows.append({"fault": name, "spoiled": _spoiled(surface, data, road), "flags": flags})
    print(pd.DataFrame([_agreement(key, part) for key, part in _parts(rows)]).round(3).to_string(index=False))
    flag_counts = (
        pd.DataFrame(fault_rows).explode("flags").groupby(["fault", "flags"]).size().unstack(fill_value=0)
    )
    fault_table = pd.DataFrame(fault_rows)
    fault_table["both"] = fault_table.spoiled & fault_table["flags"].map(lambda flags: "patch" in flags)
    counts = fault_table.assign(tiles=1).groupby("fault")[["tiles", "spoiled", "both"]].sum()
    print(counts.rename(columns={"both": "spoiled and patch"}).join(flag_counts).to_string())


def _spoiled(surface: Surface, data: TileData, road: RoadMask) -> bool:
    """Return whether a road patch larger than the flag's threshold is truly off by more than `SPOILED_M`."""
    assert data.reference is not None
    errors = np.abs(surface.lattice(data.grid.eastings, data.grid.northings) - data.reference)
    patches, _ = label(road.mask & (errors > SPOILED_M))
    return bool(np.bincount(patches[patches > 0], minlength=1).max() > Options().suspect_m2)


def _parts(rows: list[dict[str, object]]) -> Iterator[tuple[object, pd.DataFrame]]:
    return iter(pd.DataFrame(rows).groupby(["dtm", "chain"], sort=False))


def _agreement(key: object, part: pd.DataFrame) -> dict[str, object]:
    """Return rank correlations of the error estimate with the truth, and its hits among the ten worst."""
    worst = set(part.l2.nlargest(10).index) & set(part.error_estimate_m.nlargest(10).index)
    figures = {
        name: part[name].corr(part.l2, method="spearman") for name in ("residual_p95_m", "off_dtm_road")
    }
    return {
        "dtm, chain": key,
        "L2": part.l2.mean(),
        "under crowns": part.hidden.mean(),
        "error-estimate": part.error_estimate_m.mean(),
        "rho L2": part.error_estimate_m.corr(part.l2, method="spearman"),
        "rho spoiled": part.error_estimate_m.corr(part.spoiled, method="spearman"),
        "of ten worst": len(worst),
    } | figures


if __name__ == "__main__":
    main(*(int(value) for value in sys.argv[1:3])) if len(sys.argv) > 2 else main(12, 1)
