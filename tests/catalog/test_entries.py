"""Entries of catalogs that cannot be used: only their tiles are lost."""

import json
import math
import os
import re

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flexroad.catalog import Catalog, CatalogError
from tests import bad_entries
from tests.bad_entries import CHANGES, DELETED, Change, cases


@pytest.fixture(scope="module")
def valid(made_survey, tmp_path_factory):
    """The catalog of a survey in JSON."""
    path = tmp_path_factory.mktemp("valid") / "survey.json"
    Catalog.read(made_survey / "catalog.parquet").write(path)
    return path


@pytest.fixture(scope="module")
def schema(made_survey):
    return pq.read_schema(made_survey / "catalog.parquet")


def known(tiles):
    return [(tile.id, tile.grid, tile.fault) for tile in tiles]


@pytest.mark.parametrize(("kind", "change"), list(cases()), ids=lambda value: getattr(value, "name", value))
def test_bad_entry_becomes_a_tile_with_a_fault(kind, change, valid, schema, tmp_path):
    entries = bad_entries.features(valid)
    good = Catalog.read(valid).tiles
    entries[1] = change.apply(entries[1])
    path = tmp_path / f"survey.{kind}"
    if kind == "json":
        bad_entries.write_json(path, entries)
    else:
        bad_entries.write_parquet(path, entries, schema)
    tiles = Catalog.read(path).tiles
    assert known([tiles[0], *tiles[2:]]) == known([good[0], *good[2:]])
    (bad,) = (tile for tile in tiles if tile.fault)
    assert bad is tiles[1]
    assert bad.id == (good[1].id if change.keeps_id else "entry-2")
    place = "feature 2 of survey.json: " if kind == "json" else "row 2 of survey.parquet: "
    assert bad.fault.startswith(place)
    assert re.search(change.message, bad.fault)
    assert bad.fault.endswith("; correct it, or make the catalog again")
    assert bad.fault.isprintable()
    assert len(bad.fault) < 700
    assert "Error(" not in bad.fault, "the schema does not know this mistake"


@pytest.mark.parametrize("name", ["copy.parquet", "copy.json"])
def test_copy_keeps_ids_and_faults(name, valid, tmp_path):
    first, *others = bad_entries.features(valid)
    bad = [CHANGES[0].apply(first), *others[:1]]
    bad[1]["properties"]["proj:shape"] = []
    bad_entries.write_json(tmp_path / "survey.json", [first, *bad])
    catalog = Catalog.read(tmp_path / "survey.json")
    assert [bool(tile.fault) for tile in catalog.tiles] == [False, True, True]
    for movable in (True, False):
        catalog.write(tmp_path / "copies" / name, movable)
        copied = Catalog.read(tmp_path / "copies" / name)
        assert [(tile.id, tile.fault) for tile in copied.tiles] == [(t.id, t.fault) for t in catalog.tiles]
        assert copied.usable[0].grid == catalog.usable[0].grid


def test_made_up_ids_are_unique(valid, tmp_path):
    entries = bad_entries.features(valid)
    entries[0]["id"], entries[1]["id"], entries[2]["id"] = None, "entry-1", ""
    bad_entries.write_json(tmp_path / "survey.json", entries)
    ids = [tile.id for tile in Catalog.read(tmp_path / "survey.json").tiles]
    assert ids[:3] == ["entry-1x", "entry-1", "entry-3"]


def test_layer_given_twice_is_a_fault(valid, tmp_path):
    text = json.dumps(json.loads(valid.read_text()))
    path = tmp_path / "survey.json"
    path.write_text(text.replace('"dsm": {', '"dsm": {"flexroad:files": ["a.tif"]}, "dsm": {', 1))
    bad = Catalog.read(path).tiles[0]
    assert "assets.dsm: <given twice> is not an object" in bad.fault


@pytest.fixture
def table(valid, schema, tmp_path):
    """The valid entries as a table."""
    entries = bad_entries.features(valid)
    entries[0]["properties"]["flexroad:stratum"] = "stratum of one tile"
    bad_entries.write_parquet(tmp_path / "table.parquet", entries, schema)
    return pq.read_table(tmp_path / "table.parquet")


def test_dates_that_python_does_not_know_are_faults(table, tmp_path):
    dates = pa.array([10**18, 0, 0, 0], pa.int64()).cast(pa.timestamp("us", "UTC"))
    table = table.set_column(table.column_names.index("datetime"), "datetime", dates)
    pq.write_table(table, tmp_path / "survey.parquet")
    first, *others = Catalog.read(tmp_path / "survey.parquet").tiles
    assert "datetime: <" in first.fault
    assert not any(tile.fault for tile in others)


def test_text_that_is_not_utf8_is_a_fault(table, tmp_path):
    path = tmp_path / "survey.parquet"
    pq.write_table(table, path, compression="none", use_dictionary=False)
    path.write_bytes(path.read_bytes().replace(b"stratum of one tile", b"stratum of \xff\xfe\xff tile"))
    first, *others = Catalog.read(path).tiles
    assert "flexroad:stratum" in first.fault
    assert not any(tile.fault for tile in others)


def test_columns_of_other_types_are_faults(table, tmp_path):
    for name in ("id", "assets", "proj:shape", "datetime", "flexroad:root"):
        for column in (None, pa.array([1] * 4), pa.array(["a", None, "b", "c"]), pa.array([[[[1.5]]]] * 4)):
            at = table.column_names.index(name)
            other = table.remove_column(at) if column is None else table.set_column(at, name, column)
            pq.write_table(other.replace_schema_metadata(None), tmp_path / "other.parquet")
            catalog_or_error(tmp_path / "other.parquet")


FILES = {
    "empty.json": b"",
    "text.json": b"<html>404 Not Found</html>",
    "number.json": b"17",
    "list.json": b"[]",
    "no_features.json": b'{"type": "FeatureCollection"}',
    "features.json": b'{"features": {}}',
    "twice.json": b'{"features": [], "features": []}',
    "unusable.json": b'{"features": [{}, 17]}',
    "deep.json": b'{"features": [' + b"[" * 10**5 + b"]" * 10**5 + b"]}",
    "number_of_5000_digits.json": b'{"features": [' + b"1" * 5000 + b"]}",
    "utf8.json": b'{"features": ["\xff\xfe' + b"x" * 10**5 + b'"]}',
    "empty.parquet": b"",
    "text.parquet": b"<html>404 Not Found</html>",
    "cut.parquet": b"PAR1" + b"\0" * 100 + b"PAR1",
}


@pytest.mark.parametrize("name", FILES)
def test_bad_file_gives_one_line(name, tmp_path):
    (tmp_path / name).write_bytes(FILES[name])
    with pytest.raises(CatalogError, match=f"{name} is not a FlexRoad catalog: ") as caught:
        Catalog.read(tmp_path / name)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 700


@pytest.mark.parametrize("words", [["catalog", "show"], ["catalog", "check"], ["run", "--catalog"]])
def test_command_over_a_bad_file_ends_with_one_line(words, tmp_path, flexroad, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "deep.json").write_bytes(FILES["deep.json"])
    said = flexroad(*words, "deep.json", *(["--out", "run"] if words[0] == "run" else [])).expected(2)
    assert len(said.errors) == 1


def test_many_bad_entries_are_no_catalog(tmp_path, monkeypatch):
    monkeypatch.setattr("flexroad.catalog.entries.MAX_FAULTS", 10)
    (tmp_path / "c.json").write_text(json.dumps({"features": [{}] * 12}))
    with pytest.raises(CatalogError, match="more than 10 entries cannot be used"):
        Catalog.read(tmp_path / "c.json")
    pq.write_table(pa.table({"a": [1, 2]}), tmp_path / "other.parquet")
    with pytest.raises(CatalogError, match=r"no entry can be used: row 1 of other.parquet: id: missing"):
        Catalog.read(tmp_path / "other.parquet")


def test_large_file_is_not_read(tmp_path):
    path = tmp_path / "c.json"
    path.touch()
    os.truncate(path, 2**40)
    with pytest.raises(CatalogError, match="has 1,099,511,627,776 bytes, more than"):
        Catalog.read(path)


def test_table_that_unpacks_to_much_is_not_read(tmp_path, monkeypatch):
    path = tmp_path / "c.parquet"
    column = pa.array(["a" * 1_000_000] * 100)
    pq.write_table(pa.table({"id": column}), path, compression="zstd", use_dictionary=False)
    assert path.stat().st_size < 1_000_000
    monkeypatch.setattr("flexroad.catalog.geoparquet.MAX_UNPACKED", 2**26)
    with pytest.raises(CatalogError, match=r"it has 100 rows, which unpack to 0\.1 GiB"):
        Catalog.read(path)


def catalog_or_error(path) -> Catalog | None:
    """Return the catalog, None if reading it fails with one line."""
    try:
        return Catalog.read(path)
    except CatalogError as caught:
        error = caught
    assert str(error).isprintable()
    return None


def places(value, keys=()):
    """Yield the keys of every value in an entry."""
    yield keys
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, part in items:
        yield from places(part, (*keys, key))


VALUES = st.one_of(
    st.just(DELETED),
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.sampled_from([math.nan, math.inf, 1e308, 10**400, -1, 0, {}, [], [[]], {"a": [{}]}]),
    st.text(st.characters(exclude_categories=[]), max_size=20),
    st.text(min_size=1, max_size=3).map(lambda text: text * 5000),
    st.recursive(
        st.integers() | st.text(max_size=3), lambda inner: st.lists(inner, max_size=3), max_leaves=9
    ),
)


@pytest.mark.slow
@settings(max_examples=400, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_change_gives_a_catalog_or_one_line(data, valid, tmp_path):
    first, second, *_ = bad_entries.features(valid)
    entry = second
    for _ in range(data.draw(st.integers(1, 3))):
        keys = data.draw(st.sampled_from(list(places(entry))))
        value = data.draw(VALUES)
        if keys or value is not DELETED:
            entry = Change("", keys, value, "").apply(entry)
    bad_entries.write_json(tmp_path / "survey.json", [first, entry])
    catalog = catalog_or_error(tmp_path / "survey.json")
    if catalog is None:
        return
    assert not catalog.tiles[0].fault
    assert "Error(" not in catalog.tiles[1].fault
    for name in ("copy.parquet", "copy.json"):
        catalog.write(tmp_path / name, movable=False)
        copy = Catalog.read(tmp_path / name)
        assert known(copy.tiles) == known(catalog.tiles)
