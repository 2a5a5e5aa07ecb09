"""Height fields of neighbours fit together, and engines read them at the heights of the surface."""

import json
import subprocess
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.export.driver import export
from flexroad.pipeline.export.height_fields import Lattice
from flexroad.pipeline.export.source import Options, select
from tests import validators

READER = Path(__file__).parents[2] / "validators" / "cast_rays.py"


@pytest.fixture(scope="module")
def fields(town, tmp_path_factory):
    out = tmp_path_factory.mktemp("fields")
    export(select(town.path), out, ["heightfield"], Options(), SerialExecutor())
    return out / "heightfield"


def places(folder):
    return {file: json.loads(file.read_text()) for file in sorted(folder.glob("*.json"))}


def test_settings_of_unreal_are_given_for_its_sizes_alone(fields):
    for place in places(fields).values():
        assert place["size"] == [65, 65]
        assert "unreal" not in place


def test_nodes_on_borders_of_neighbours_have_the_same_value(fields):
    """Also in the numbers of 16 bits, for which the steps must be the same."""
    shared = 0
    for (a, first), (b, second) in combinations(places(fields).items(), 2):
        one, other = (np.asarray(Image.open(file.with_suffix(".png"))) for file in (a, b))
        assert (first["low_m"], first["high_m"]) == (second["low_m"], second["high_m"])
        west, south, east, north = first["bounds"]
        if (east, south) == tuple(second["bounds"][:2]):
            np.testing.assert_array_equal(one[:, -1], other[:, 0])
            shared += 1
        if (west, north) == tuple(second["bounds"][:2]):
            np.testing.assert_array_equal(one[0], other[-1])
            shared += 1
    assert shared == 2


def test_limits_are_whole_metres_around_the_heights_of_all_tiles(town, fields):
    heights = []
    for file, place in places(fields).items():
        assert place["low_m"] == int(place["low_m"])
        assert place["high_m"] == int(place["high_m"])
        heights.append(np.asarray(Image.open(file.with_suffix(".png"))) * place["step_m"])
    assert 0 <= np.min(heights) < 1
    assert 0 <= place["high_m"] - place["low_m"] - np.max(heights) < 1


def test_fields_of_unreal_have_its_sizes_and_the_same_heights(town, tmp_path):
    export(select(town.path), tmp_path, ["heightfield"], Options(nodes="unreal"), SerialExecutor())
    found = places(tmp_path / "heightfield")
    # Column from the west and row from the north; the tile in the north-east is not finished.
    west, _, _, north = np.array([place["bounds"] for place in found.values()]).T
    names = [
        f"heightfield_x{round((x - west.min()) / 60)}_y{round((north.max() - y) / 60)}"
        for x, y in zip(west, north, strict=True)
    ]
    assert [file.stem for file in found] == names
    assert len(set(names)) == 3
    for file, place in found.items():
        assert place["size"] == [127, 127]
        assert file.with_name(file.name.replace("heightfield", "holes")).with_suffix(".png").exists()
        values = np.asarray(Image.open(file.with_suffix(".png")), float)
        west, south, east, north = place["bounds"]
        heights, _ = town.at(np.linspace(west, east, 127), np.linspace(north, south, 127)[:, None])
        assert (
            np.abs(place["low_m"] + values * place["step_m"] - heights).max() <= place["precision_m"] * 1.01
        )


def test_rays_of_mujoco_hit_the_heights_of_the_surface(town, fields):
    """At nodes, and between them within the error of triangles; the tiles lie in one scene."""
    rng = np.random.default_rng(0)
    nodes, between = [], []
    for place in places(fields).values():
        steps = rng.integers(1, place["size"][0] - 1, (200, 2))
        corner = np.array(place["bounds"][:2])
        nodes.append(corner + steps * place["spacing_m"])
        between.append(corner + (steps + rng.uniform(0, 1, (200, 2))) * place["spacing_m"])
    points = np.concatenate(nodes + between)
    # Beside the node the ray does not meet the edges of triangles.
    rays = points + np.repeat([[1e-4], [0.0]], len(points) // 2, axis=0)
    done = subprocess.run(
        [validators.python(), READER, fields],
        input=json.dumps(rays.tolist()),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    heights, _ = town.at(*points.T)
    error = np.abs(np.array(json.loads(done.stdout), float) - heights).reshape(2, -1)
    assert error[0].max() < 0.0005
    # A triangle cannot follow the steps beside roads.
    smooth = town.is_smooth(*points[len(points) // 2 :].T, max(place["spacing_m"]))
    assert smooth.mean() > 0.3
    assert np.median(error[1][smooth]) < 0.001
    assert error[1][smooth].max() < 0.01


def test_tile_without_heights_is_named(town, tmp_path, monkeypatch):
    source = select(town.path)

    class Nothing:
        def lattice(self, eastings, northings):
            return np.full((len(northings), len(eastings)), np.nan)

    monkeypatch.setattr("flexroad.pipeline.run.finished.FinishedTile.surface", Nothing())
    with pytest.raises(ConfigError, match=f"tile {source.tiles[0].id}: the surface has no height"):
        export(source, tmp_path, ["heightfield"], Options(), SerialExecutor())


def test_tiles_without_a_common_lattice_have_none(town):
    first, *others = town.tiles
    for grid in (
        replace(first.grid, west=first.grid.west + 7),
        replace(first.grid, width=first.grid.width + 60),
        others[0].grid,
    ):
        assert Lattice.of([*others, replace(first, grid=grid)]) is None
    assert Lattice.of(town.tiles).place(first) == (0, 1)
