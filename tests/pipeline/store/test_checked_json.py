"""JSON files with a checksum."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexroad.pipeline.store.records import CHECKSUM, dump_checked, load_checked

values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)
CONTENT = {"id": "a", "rows": [{"road_l2": 0.0281, "tile": "ä"}], "size": 17}


@given(content=st.dictionaries(st.text(), values, max_size=5).filter(lambda c: CHECKSUM not in c))
def test_loads_what_was_dumped(content):
    assert load_checked(dump_checked(content)) == content


def test_any_flipped_bit_is_noticed_or_changes_no_value():
    data = dump_checked(CONTENT)
    noticed = 0
    for at in range(len(data)):
        for bit in range(8):
            copy = bytearray(data)
            copy[at] ^= 1 << bit
            try:
                assert load_checked(bytes(copy)) == CONTENT
            except ValueError:
                noticed += 1
    assert noticed > 7 * len(data)


def test_format_and_order_of_keys_do_not_matter():
    content = json.loads(dump_checked(CONTENT))
    again = json.dumps(dict(reversed(content.items())), separators=(",", ":"), ensure_ascii=False)
    assert load_checked(again.encode()) == CONTENT


@pytest.mark.parametrize(
    "data", [b"", b"[]", b"{}", b"1", b"null", json.dumps(CONTENT).encode(), b"[" * 100_000, b"\xff\xfe{"]
)
def test_other_files_raise_value_error(data):
    with pytest.raises(ValueError, match="."):
        load_checked(data)


def test_numbers_that_json_lacks_raise_error():
    with pytest.raises(ValueError, match="JSON"):
        dump_checked({"height": np.inf})
