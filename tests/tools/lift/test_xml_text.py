"""XML copied byte by byte, with some elements changed."""

import gzip
import io

import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexroad.tasks.errors import TaskError
from flexroad.tools.lift import xml_text
from flexroad.tools.lift.xml_text import parts

DATA = (
    b'<?xml version="1.0"?>\n<!-- <a> --><net>\n <a x="1>2" y=\'3\'/><!--c-->'
    b'<a><b/><a/><![CDATA[<a>]]>t</a>\n<x><a z="&amp;"></a></x>\xc3\xa4</net>\n\n'
)


def read(data: bytes, *names: str) -> list:
    return list(parts(io.BytesIO(data), names))


@pytest.mark.parametrize("size", [1, 2, 3, 7, 1000])
def test_pieces_are_the_file_and_parts_the_outer_elements(size, monkeypatch):
    monkeypatch.setattr(xml_text, "CHUNK_BYTES", size)
    found = read(DATA, "a")
    assert b"".join(each if isinstance(each, bytes) else each.text for each in found) == DATA
    chosen = [each for each in found if not isinstance(each, bytes)]
    assert [part.text for part in chosen] == [
        b"<a x=\"1>2\" y='3'/>",
        b"<a><b/><a/><![CDATA[<a>]]>t</a>",
        b'<a z="&amp;"></a>',
    ]
    assert [part.path for part in chosen] == [("net",), ("net",), ("net", "x")]
    whole = chosen[1]
    assert [whole.text[slice(*whole.spans[each])] for each in whole.element] == [b"<b/>", b"<a/>"]
    assert whole.element[1].tail == "<a>t"


def test_attributes_are_replaced_in_place_or_added():
    first, _, last = (each for each in read(DATA, "a") if not isinstance(each, bytes))
    changed = first.with_attributes(first.element, {"y": "5", "w": "2"})
    assert first.replaced([changed]) == b'<a x="1>2" y="5" w="2"/>'
    changed = last.with_attributes(last.element, {"w": 'a"<'})
    assert last.replaced([changed]) == b'<a z="&amp;" w="a&quot;&lt;"></a>'


def test_an_attribute_is_not_mistaken_for_the_end_of_another_name_or_a_value():
    (part,) = (
        each for each in read(b'<a lat_z="1" t=" z=\'2\'" z="3"/>', "a") if not isinstance(each, bytes)
    )
    changed = part.with_attributes(part.element, {"z": "4"})
    assert part.replaced([changed]) == b'<a lat_z="1" t=" z=\'2\'" z="4"/>'


@pytest.mark.parametrize(
    ("before", "after"),
    [(b"<a/>", b"<a><c/></a>"), (b"<a >b</a >", b"<a >b<c/></a >"), (b"<a x='/' />", b"<a x='/'><c/></a>")],
)
def test_children_are_added_at_the_end(before, after):
    (part,) = read(before, "a")
    assert part.replaced([part.with_child(part.element, "<c/>")]) == after


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"<net><a>", "not complete XML: no element found, line 1, column 9"),
        (b"", "not complete XML"),
        (b"<a/><b/>", "junk after document element"),
        (b'<!DOCTYPE n [<!ENTITY a "b">]><n/>', "declares the entity 'a'"),
        (b'<!DOCTYPE n [<!ENTITY a SYSTEM "/etc/hostname">]><n>&a;</n>', "declares the entity 'a'"),
        ("<a/>".encode("utf-16"), "is in UTF-16"),
        ("<a/>".encode("utf-16-le"), "is in UTF-16"),
        (b"<?xml version='1.0' encoding='koi8-r'?><a/>", "is in 'koi8-r'"),
        (b"<a>" * 300, "more than 200 elements within each other"),
    ],
)
def test_bad_files_have_one_line(data, words):
    with pytest.raises(TaskError, match=words) as raised:
        read(data, "b")
    assert "\n" not in str(raised.value)


def test_an_element_is_not_read_beyond_the_limit(monkeypatch):
    monkeypatch.setattr(xml_text, "LARGEST_BYTES", 2**20)
    with pytest.raises(TaskError, match="an element a of more than 1 MiB"):
        read(b"<n><a>" + b" " * 2**22 + b"</a></n>", "a")


def test_compressed_files_are_told_by_their_name(tmp_path):
    path = tmp_path / "net.xml.gz"
    with xml_text.written(path) as file:
        file.write(DATA)
    assert gzip.decompress(path.read_bytes()) == DATA
    assert xml_text.root_name(path) == "net"
    with xml_text.opened(path) as file:
        assert file.read() == DATA
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(TaskError, match="cannot be read"), xml_text.opened(path) as file:
        list(parts(file, {"a"}))


TEXT = st.text(st.characters(min_codepoint=32, max_codepoint=0x17F), max_size=8)


@st.composite
def documents(draw, depth=3) -> str:
    name = draw(st.sampled_from("abc"))
    attributes = "".join(
        f' {key}="{draw(TEXT).replace("&", "").replace("<", "").replace(chr(34), "")}"'
        for key in draw(st.sets(st.sampled_from("xyz"), max_size=2))
    )
    inside = "".join(draw(st.lists(documents(depth - 1), max_size=3))) if depth else ""
    return draw(
        st.sampled_from([f"<{name}{attributes} />", f"<{name}{attributes}>{inside}<!--a--></{name}>"])
    )


@given(documents(), st.integers(1, 9))
def test_any_document_is_copied(document, size):
    data, before = document.encode(), xml_text.CHUNK_BYTES
    try:
        xml_text.CHUNK_BYTES = size
        found = read(data, "a", "b")
    finally:
        xml_text.CHUNK_BYTES = before
    assert b"".join(each if isinstance(each, bytes) else each.text for each in found) == data
    for part in found:
        if not isinstance(part, bytes):
            for element, (start, end) in part.spans.items():
                assert part.text[start:end].startswith(f"<{element.tag}".encode())
                assert part.text[start:end].endswith((b"/>", f"</{element.tag}>".encode()))
