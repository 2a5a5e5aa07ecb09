"""Text from files for display: without control characters, in one line."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Callable, Iterable, Sequence
from typing import Any

Notify = Callable[[str], None]
"""Takes a line for the user."""
MAX_SHOWN = 160
"""Longest text of a value in a message."""
MAX_REASON = 500
"""Longest message of a library in a message."""
MAX_LINE = 200
"""Longest line of an error of a decoder in a message."""
FORMULA = ("=", "+", "-", "@", "\t", "\n")
"""Characters at the start of texts that spreadsheets take for formulas."""
_NUMBER = re.compile(r"[+-][\d.,_]*(?:[eE][+-]?\d+)?%?(?: [a-z][^=@(|!]*)?")
_CREDENTIALS = re.compile(r"(:/{1,2})(?:[^/\s@:]*:\S*|[^/\s@]+)@|^[^/\s@:]*:[^/\s]\S*@")
_SIGNATURE = re.compile(r"(https?:/\S*\?)\S+")
_REPR = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = _REPR.maxlong = 60


def printable(text: str) -> str:
    r"""Return a text with escapes (``\x1b``, ``\u202e``) for characters that cannot be printed.

    These are control characters, line breaks, reversals of the direction and lone surrogates. A file name or
    a tag may have them, and a terminal would obey them.
    """
    return text if text.isprintable() else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def without_credentials(text: str) -> str:
    """Return a text with ``***`` for the user and password, and the query, of each address in it."""
    if "@" not in text and "?" not in text:
        return text
    return _SIGNATURE.sub(r"\1***", _CREDENTIALS.sub(r"\1***@", text))


def no_formula(value: Any) -> Any:
    """Return a cell of a table for CSV, with an apostrophe first if its text could be taken for a formula.

    Numbers as text (``-5.2``), also with words after them, and ids of digits (``-500_5600``) are unchanged.
    `with_formula` is the inverse.
    """
    if not isinstance(value, str):
        return value
    # Python's writers of CSV put only some line breaks into quotes.
    text = value.replace("\r\n", "\n").replace("\r", "\n")
    return "'" + text if text.startswith(FORMULA) and not _NUMBER.fullmatch(text) else text


def with_formula(text: str) -> str:
    """Return the original text of a cell that `no_formula` has changed; any other text is unchanged."""
    plain = text.removeprefix("'")
    return plain if no_formula(plain) == text else text


def count(number: int, noun: str) -> str:
    """Return a number with its noun: ``1 tile``, ``2 tiles``."""
    return f"{number} {noun}{'s' * (number != 1)}"


def some(names: Sequence[str]) -> str:
    """Return the first three names and the number of the others, for a message."""
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(names[:3]) + more


def edges(bounds: Iterable[float]) -> str:
    """Return bounds for messages: west, south, east and north with up to ten digits."""
    return " ".join(f"{edge:.10g}" for edge in bounds)


def shown(value: object) -> str:
    """Return a value from a file in a short form, for messages."""
    text = printable(_REPR.repr(value))
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}..."


def reason(error: BaseException) -> str:
    """Return the first line of an error's message in a short form: libraries repeat what a file contains."""
    text = printable(str(error).strip().partition("\n")[0])
    return text if len(text) <= MAX_REASON else f"{text[:MAX_REASON]}..."


def access_reason(error: BaseException) -> str | None:
    """Return why the system refuses to read a file, to follow its name; None if its content is at fault."""
    words = getattr(error, "strerror", None)
    return f"cannot be read: {words}" if words else None


def write_reason(error: BaseException) -> str:
    """Return why a file could not be written, in the words of the system or of GDAL."""
    return getattr(error, "strerror", None) or reason(error.__cause__ or error)


def one_line(error: BaseException) -> str:
    """Return an error's complete message as one short line, or its type if it has none."""
    return " ".join(str(error).split())[:MAX_LINE] or type(error).__name__
