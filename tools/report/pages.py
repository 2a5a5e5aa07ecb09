"""Pages of a report: its tables as Markdown, CSV and HTML."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from numbers import Integral, Real
from pathlib import Path

import jinja2
import pandas as pd
from markupsafe import Markup

from flexroad.catalog.text import printable
from flexroad.pipeline.store.tables import csv_text
from flexroad.tasks.quality.flagged import Place
from flexroad.tools.report.content import MAIN, Content

PRINTED = re.compile(r"–|[+-]?\d[\d,]*(\.\d+)?%?( \[.*\])?")
"""A number as text, with its interval, if any."""
MARKUP = re.compile(r"[\\`*|~$]|<(?=[A-Za-z/!?])|^>|(?<![^\W_])_|_(?![^\W_])|\](?=[\[(:])|&(?=#?\w+;)")
"""Characters that are markup in Markdown at this place: not, for example, ``_`` within a word."""
ENTITIES = {"<": "&lt;", ">": "&gt;", "&": "&amp;"}
"""Replacements of characters that some programs take for HTML even after a backslash."""

Section = tuple[str, pd.DataFrame, str]
"""Title, table, and explanation or an empty text."""


@dataclass(frozen=True, eq=False)
class TilePictures:
    """The pictures and notes of one tile."""

    tile_id: str
    pictures: tuple[tuple[str, bytes], ...]
    """Caption and picture; the first and the last picture show most."""
    notes: tuple[str, ...] = ()
    places: Mapping[str, Place] = field(default_factory=dict)
    """Place to look at, by flag."""


def markdown_page(content: Content) -> str:
    """Return the report as Markdown."""
    left_out = [f"The catalog {marked(line)}." for line in content.counts.left_out]
    parts = [f"# {marked(content.title)}", content.state + ".", *left_out, marked(content.reference)]
    parts += markdown_sections(sections(content))
    versions = marked(", ".join(f"{name} {version}" for name, version in content.versions.items()))
    fence = "`" * max(3, 1 + max(map(len, re.findall("`+", content.config)), default=0))
    config = _without_controls(content.config)
    parts += ["## Configuration", f"{fence}yaml\n{config}{fence}", f"Versions: {versions}."]
    return "\n\n".join(parts) + "\n"


def csv_page(content: Content) -> str:
    """Return the main table as CSV, unrounded."""
    return csv_text(content.tables[MAIN][0])


def template(name: str, *folders: Path) -> jinja2.Template:
    """Return a template from the given folders or this one, with filters for tables and pictures."""
    loader = jinja2.FileSystemLoader([*folders, Path(__file__).parent])
    environment = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, finalize=_without_controls
    )
    environment.filters["table"] = _html
    environment.filters["inline"] = inline
    return environment.get_template(name)


def inline(picture: bytes) -> str:
    """Return a PNG or WebP picture as an address that has its bytes."""
    kind = "webp" if picture[8:12] == b"WEBP" else "png"
    return f"data:image/{kind};base64,{base64.b64encode(picture).decode()}"


def sections(content: Content) -> list[Section]:
    """Return every table that is not empty."""
    return [(title, *entry) for title, entry in content.tables.items() if len(entry[0])]


def are_numbers(table: pd.DataFrame) -> list[bool]:
    """Return for each column whether its values are numbers or texts of numbers."""
    return [
        pd.api.types.is_numeric_dtype(column) or all(PRINTED.fullmatch(str(cell)) for cell in column)
        for _, column in table.items()
    ]


def _cell(value: object, column: str) -> str:
    if pd.isna(value):  # type: ignore[call-overload]
        return "–"
    if isinstance(value, Real):
        return f"{value:,.0f}" if isinstance(value, Integral) or column == "T" else f"{value:.3f}"
    return printable(str(value))


def _cells(table: pd.DataFrame) -> list[list[str]]:
    columns = list(table.columns)
    return [
        [_cell(value, name) for name, value in zip(columns, row, strict=True)]
        for row in table.itertuples(index=False, name=None)
    ]


def _without_controls(value: object) -> object:
    """Return a text with control characters escaped, except line breaks; other values are unchanged."""
    if not isinstance(value, str) or isinstance(value, Markup):
        return value
    return "\n".join(map(printable, value.split("\n")))


def marked(text: str) -> str:
    """Return a text for Markdown, with markup escaped."""
    return MARKUP.sub(lambda found: ENTITIES.get(found[0], f"\\{found[0]}"), printable(text))


def markdown_sections(parts: Iterable[Section]) -> Iterator[str]:
    """Yield the headings, explanations and tables of a page as Markdown texts."""
    for title, table, line in parts:
        yield from (f"## {marked(title)}", *([line] if line else []), markdown(table))


def markdown(table: pd.DataFrame) -> str:
    """Return a table as Markdown text."""
    numeric = are_numbers(table)
    lines = [list(table.columns), ["---:" if number else "---" for number in numeric], *_cells(table)]
    return "\n".join("| " + " | ".join(map(marked, line)) + " |" for line in lines)


def _html(table: pd.DataFrame) -> Markup:
    kinds = ["number" if number else "text" for number in are_numbers(table)]

    def line(tag: str, cells: Iterable[object]) -> Markup:
        cell = Markup(f'<{tag} class="{{}}">{{}}</{tag}>')
        return Markup("<tr>{}</tr>").format(
            Markup("").join(cell.format(kind, value) for kind, value in zip(kinds, cells, strict=True))
        )

    body = Markup("").join(line("td", row) for row in _cells(table))
    return Markup("<table><thead>{}</thead><tbody>{}</tbody></table>").format(line("th", table.columns), body)
