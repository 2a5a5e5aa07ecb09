"""The state of tiles is checked once for all formats, and later changes are noticed."""

import os
from collections import Counter
from dataclasses import replace

import pytest

from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.graph.graph import Pattern
from flexroad.pipeline.run import finished
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.tools.export.source import select


def source_file(city, tile_id, layer="dtm"):
    return city.survey / layer / f"{tile_id}.tif"


def test_graphs_are_made_once_for_all_passes(made_city, monkeypatch):
    graphs, graph = Counter(), Pattern.graph

    def counted(pattern, tile, *arguments):
        graphs[tile.id] += 1
        return graph(pattern, tile, *arguments)

    monkeypatch.setattr(Pattern, "graph", counted)
    chosen = select(made_city.path, made_city.done)
    for _ in range(3):
        for tile in chosen.finished():
            assert len(tile.mesh.faces)
            assert tile.surface.height(*tile.tile.grid.bounds[:2])
    assert graphs == Counter(made_city.done)


def test_mesh_distances_are_the_largest_of_the_tiles_that_have_them(made_city):
    chosen = select(made_city.path, made_city.done)
    nan = float("nan")
    pairs = zip(chosen.snapshots, [(0.01, nan, nan, nan), (0.02, 0.5, nan, nan)], strict=True)
    few = replace(chosen, snapshots=tuple(replace(one, distances=values) for one, values in pairs))
    assert few.mesh_distances == {"mesh_p95_road_m": 0.02, "mesh_max_road_m": 0.5}


def test_tile_whose_source_changed_is_no_longer_finished(own_city):
    chosen = select(own_city.path)
    assert len(list(chosen.finished())) == 2
    file = source_file(own_city, own_city.done[1])
    os.utime(file, ns=(1, 1))
    passed = chosen.finished()
    assert next(passed).id == own_city.done[0]
    with pytest.raises(
        ConfigError, match=f"tile {own_city.done[1]} is no longer finished; run `flexroad rerun"
    ):
        next(passed)


def test_tile_without_source_files_is_still_finished_and_one_without_its_marker_is_left_out(own_city):
    first, second = own_city.done
    (own_city.path / "tiles" / second / "item.json").unlink()
    chosen = select(own_city.path)
    source_file(own_city, first).unlink()
    (tile,) = chosen.finished()
    assert tile.graph.fingerprint == tile.snapshot.fingerprint
    assert len(tile.mesh.faces)
    assert (tile.id, second in chosen.left_out) == (first, True)


def test_tile_with_another_result_than_at_the_start_is_refused(own_city):
    chosen = select(own_city.path)
    os.utime(source_file(own_city, own_city.done[0]), ns=(1, 1))
    run_tiles(Run.open(own_city.path), SerialExecutor())
    with pytest.raises(ConfigError, match=f"tile {own_city.done[0]}: it was computed again while"):
        list(chosen.finished())


def test_tile_that_was_written_again_with_the_same_result_is_still_finished(own_city):
    chosen = select(own_city.path)
    before = next(chosen.finished())
    run_tiles(Run.open(own_city.path), SerialExecutor(), force=frozenset({"export"}))
    with pytest.raises(ConfigError, match="it was computed again while it was exported; export again"):
        before.check_unchanged()
    for tile in chosen.finished():
        tile.check_unchanged()


@pytest.mark.parametrize("damage", ["deleted", "truncated"])
def test_result_that_the_store_lost_is_computed_from_the_sources(own_city, made_city, damage):
    kept = [tile.mesh.vertices for tile in select(made_city.path).finished()]
    damage_store(own_city, damage)
    for tile, vertices in zip(select(own_city.path).finished(), kept, strict=True):
        assert (tile.mesh.vertices == vertices).all()


def test_result_that_store_and_sources_lost_is_an_error_of_one_line(own_city):
    damage_store(own_city, "deleted")
    for file in (own_city.survey / "dsm").iterdir():
        file.unlink()
    first = next(select(own_city.path).finished())
    with pytest.raises(ConfigError, match=f"tile {own_city.done[0]}: load: .*dsm") as error:
        _ = first.mesh
    assert "\n" not in str(error.value)


def damage_store(city, damage):
    for stage in ("sample", "fit"):
        for file in (city.path / "store" / stage).rglob("*.npz"):
            if damage == "deleted":
                file.unlink()
            else:
                file.write_bytes(file.read_bytes()[:-100])


def test_files_of_a_tile_are_looked_up_before_its_state(own_city, monkeypatch):
    """A change between the two is noticed in the next pass."""
    file = source_file(own_city, own_city.done[0])
    peek = finished.peek_statuses

    def then_changed(run, tiles):
        for number, status in enumerate(peek(run, tiles)):
            if number == 0:
                os.utime(file, ns=(1, 1))
            yield status

    monkeypatch.setattr(finished, "peek_statuses", then_changed)
    chosen = select(own_city.path)
    monkeypatch.setattr(finished, "peek_statuses", peek)
    with pytest.raises(ConfigError, match="no longer finished"):
        list(chosen.finished())
