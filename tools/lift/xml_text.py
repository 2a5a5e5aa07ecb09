"""XML files copied byte by byte, with some elements changed.

A file is read once, in pieces, so that memory does not grow with it. Chosen elements are yielded as trees,
with the places of their parts in the text. All other text is yielded unchanged.
"""

from __future__ import annotations

import gzip
import re
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, cast
from xml.etree import ElementTree as ET
from xml.parsers import expat

from flexroad.catalog.text import reason, shown
from flexroad.tasks.errors import TaskError

CHUNK_BYTES = 2**18
LARGEST_BYTES = 2**26
"""Largest text of a chosen element."""
DEEPEST = 200
"""Largest depth of elements."""
ENCODINGS = ("utf-8", "us-ascii", "iso-8859-1", "windows-1252")
"""Encodings in which the characters of ASCII are one byte each."""
START_TAG = re.compile(rb"""<[^>"']*(?:"[^"]*"[^>"']*|'[^']*'[^>"']*)*>""")
ATTRIBUTE = re.compile(rb"""\s(([^\s=<>"']+)\s*=\s*(?:"[^"]*"|'[^']*'))""")
LATER = "; save it again with a program that writes plain XML in UTF-8"


@dataclass(frozen=True, eq=False)
class Part:
    """An element with its text in the file."""

    element: ET.Element
    text: bytes
    spans: Mapping[ET.Element, tuple[int, int]] = field(repr=False)
    """Start and end in ``text`` of the element and of all elements in it."""
    path: tuple[str, ...] = ()
    """The names of the elements around it, from the root."""

    def start_tag(self, element: ET.Element) -> tuple[int, int]:
        """Return start and end of the start tag of an element."""
        start, _ = self.spans[element]
        found = START_TAG.match(self.text, start)
        assert found is not None
        return start, found.end()

    def inside(self, element: ET.Element) -> tuple[int, int] | None:
        """Return start and end of the text in an element; None if it is an empty tag."""
        _, first = self.start_tag(element)
        if self.text[first - 2 : first] == b"/>":
            return None
        return first, self.text.rindex(b"</", first, self.spans[element][1])

    def with_child(self, element: ET.Element, text: str) -> tuple[int, int, bytes]:
        """Return the edit that inserts a text before the end of an element."""
        place = self.inside(element)
        if place is not None:
            return place[1], place[1], text.encode("ascii")
        start, end = self.start_tag(element)
        head = self.text[start:end].removesuffix(b"/>").rstrip()
        return start, end, head + f">{text}</{element.tag}>".encode("ascii")

    def replaced(self, edits: Iterable[tuple[int, int, bytes]]) -> bytes:
        """Return the text with some stretches replaced: start, end and new text of each.

        Edits must not overlap. Edits of length 0 insert text.
        """
        parts, at = list[bytes](), 0
        for start, end, new in sorted(edits, key=lambda edit: edit[:2]):
            assert at <= start <= end
            parts += [self.text[at:start], new]
            at = end
        return b"".join([*parts, self.text[at:]])

    def with_attributes(self, element: ET.Element, values: Mapping[str, str]) -> tuple[int, int, bytes]:
        """Return the edit that gives an element attributes; existing attributes are replaced."""
        start, end = self.start_tag(element)
        tag = self.text[start:end]
        for name, value in values.items():
            text = value.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
            new = f'{name}="{text}"'.encode("ascii")
            own = [found for found in ATTRIBUTE.finditer(tag) if found[2] == name.encode()]
            if own:
                tag = tag[: own[0].start(1)] + new + tag[own[0].end(1) :]
            else:
                head = tag[: -2 if tag.endswith(b"/>") else -1].rstrip()
                tag = head + b" " + new + tag[len(head) :]
        return start, end, tag


def opened(path: Path) -> BinaryIO:
    """Open a file to read; a file whose name ends in ``.gz`` is unpacked."""
    return cast("BinaryIO", gzip.open(path)) if path.suffix.lower() == ".gz" else path.open("rb")


@contextmanager
def written(path: Path) -> Iterator[BinaryIO]:
    """Open a file to write; a file whose name ends in ``.gz`` is compressed, without a time in it."""
    with path.open("wb") as file:
        if path.suffix.lower() != ".gz":
            yield file
            return
        with gzip.GzipFile(filename="", fileobj=file, mode="wb", mtime=0) as packed:
            yield cast("BinaryIO", packed)


def root_name(path: Path) -> str:
    """Return the name of the outermost element of a file."""
    with opened(path) as file:
        names = list[str]()

        def start(name: str, attributes: dict[str, str]) -> None:
            names.append(name)

        parser = expat.ParserCreate()
        parser.StartElementHandler = start
        parser.XmlDeclHandler = _declaration
        try:
            while not names and (data := file.read(CHUNK_BYTES)):
                parser.Parse(data)
        except expat.ExpatError as error:
            if not names:
                raise _broken(error) from error
        except (OSError, EOFError, zlib.error) as error:
            raise TaskError(f"cannot be read: {reason(error)}") from error
    return names[0] if names else ""


def parts(file: BinaryIO, names: Collection[str]) -> Iterator[bytes | Part]:
    """Yield a file as elements with given names and the text between them; all joined give the file.

    If such elements contain each other, the outer element is yielded.

    - `names`: names of elements, as in the file.
    """
    reader = _Reader(names)
    try:
        while data := file.read(CHUNK_BYTES):
            yield from reader.feed(data)
        yield from reader.feed(b"")
    except expat.ExpatError as error:
        raise _broken(error) from error
    except (OSError, EOFError, zlib.error) as error:
        raise TaskError(f"cannot be read: {reason(error)}") from error


def elements(path: Path, names: Collection[str]) -> Iterator[Part]:
    """Yield the elements of a file with given names."""
    with opened(path) as file:
        for part in parts(file, names):
            if isinstance(part, Part):
                yield part


def _broken(error: expat.ExpatError) -> TaskError:
    where = f"line {error.lineno}, column {error.offset + 1}"
    return TaskError(f"is not complete XML: {expat.ErrorString(error.code)}, {where}; save it again")


def _declaration(version: str, encoding: str | None, standalone: int) -> None:
    """Raise an error if a file declares an encoding that is not read."""
    if (encoding or "utf-8").lower() not in ENCODINGS:
        raise TaskError(f"is in {shown(encoding)}{LATER}")


class _Reader:
    """The state of reading a file: the text that is not yielded yet, and the current element."""

    def __init__(self, names: Collection[str]) -> None:
        self.names = frozenset(names)
        self.parser = expat.ParserCreate()
        self.parser.buffer_text = True
        self.parser.XmlDeclHandler = _declaration
        self.parser.EntityDeclHandler = self.entity
        self.parser.StartElementHandler = self.start
        self.parser.EndElementHandler = self.end
        self.parser.CharacterDataHandler = self.characters
        self.ready: list[bytes | Part] = []
        self.text, self.offset = bytearray(), 0
        """Text from a place in the file on."""
        self.path: list[str] = []
        self.open: list[tuple[ET.Element, int]] = []
        self.spans: dict[ET.Element, tuple[int, int]] = {}
        self.outer = 0
        """Number of elements around the current element."""

    def feed(self, data: bytes) -> Iterator[bytes | Part]:
        if self.offset == 0 and not self.text and data.startswith((b"\xff\xfe", b"\xfe\xff", b"\0", b"<\0")):
            raise TaskError(f"is in UTF-16{LATER}")
        self.text += data
        self.parser.Parse(data, not data)
        if not self.open:
            # Text that the parser has not passed may be the start of an element.
            self.pass_to(self.parser.CurrentByteIndex if data else self.offset + len(self.text))
        elif len(self.text) > LARGEST_BYTES:
            name = self.open[0][0].tag
            raise TaskError(f"has an element {name} of more than {LARGEST_BYTES >> 20} MiB{LATER}")
        yield from self.ready
        self.ready.clear()

    def pass_to(self, index: int) -> None:
        length = index - self.offset
        if length > 0:
            self.ready.append(bytes(self.text[:length]))
            del self.text[:length]
            self.offset = index

    def entity(self, name: str, *_: Any) -> None:
        raise TaskError(f"declares the entity {shown(name)}{LATER}")

    def start(self, name: str, attributes: dict[str, str]) -> None:
        self.path.append(name)
        if len(self.path) > DEEPEST:
            raise TaskError(f"has more than {DEEPEST} elements within each other{LATER}")
        index = self.parser.CurrentByteIndex
        if not self.open:
            if name not in self.names:
                return
            self.pass_to(index)
            self.outer = len(self.path) - 1
        element = ET.Element(name, attributes)
        if self.open:
            self.open[-1][0].append(element)
        self.open.append((element, index - self.offset))

    def characters(self, text: str) -> None:
        if self.open:
            element = self.open[-1][0]
            if len(element):
                element[-1].tail = (element[-1].tail or "") + text
            else:
                element.text = (element.text or "") + text

    def end(self, name: str) -> None:
        path = tuple(self.path[: self.outer])
        self.path.pop()
        if not self.open:
            return
        element, start = self.open.pop()
        tag = START_TAG.match(self.text, start)
        assert tag is not None
        end = tag.end()
        if self.text[end - 2 : end] != b"/>":
            end = self.text.index(b">", self.parser.CurrentByteIndex - self.offset) + 1
        self.spans[element] = start, end
        if not self.open:
            self.ready.append(Part(element, bytes(self.text[:end]), self.spans, path))
            self.spans = {}
            del self.text[:end]
            self.offset += end
