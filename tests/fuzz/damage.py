"""Random damage of files: bytes of any format, and words of texts."""

import re
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

WORDS = (b"\xff\xff\xff\xff", b"\0\0\0\x80", b"\0\0\0\0", b"\xff\xff\xff\x7f", b"\0\0\xc0\x7f")
"""Largest, smallest and no number, as integers and as floats."""
HEADER = 400
"""Length of the part at the beginning that most checks are about (bytes)."""
TOKEN = re.compile(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?|[A-Za-z_:][\w:.-]*|\"[^\"\n]*\"|[{}\[\]<>/=,]")
STRANGE = (
    *"0 -1 1e309 -1e300 0.1e-300 nan inf 4294967295 9223372036854775808 null true [] {} * &a !!".split(),
    *"\"\" '' ../../../x EPSG:4326 EPSG:0 %s%n ${HOME}".split(),
    *("\0", "\ud7ff", "\x1b[2J", "\u202e"),
    *("9" * 5000, "a" * 3000, "[" * 2000, "{" * 500, "<" * 500),
)
"""Words that are wrong in most places."""


def damaged(data: bytes, n: int, seed: int) -> Iterator[bytes]:
    """Yield copies of a file with random bytes, with extreme numbers, or cut off."""
    rng = np.random.default_rng(seed)
    for _ in range(n):
        yield damage(data, rng)


def damage(data: bytes, rng: np.random.Generator) -> bytes:
    """Return a copy of a file with random bytes, with extreme numbers, or cut off."""
    copy, kind = bytearray(data), rng.integers(7)
    if kind == 0:
        return data[: rng.integers(len(data) + 1)]
    if kind == 1:
        # A part is lost or repeated.
        start, end = sorted(rng.integers(len(data) + 1, size=2))
        again = bytes(copy[start:end]) if rng.random() < 0.5 else b""
        return bytes(copy[:start] + again + again + copy[end:])
    end = min(len(data), HEADER) if kind < 4 else len(data)
    for at in rng.integers(end, size=rng.integers(1, 9)) if end else ():
        if kind == 5:
            copy[at : at + 4] = WORDS[rng.integers(len(WORDS))]
        elif kind == 6:
            copy[at] ^= 1 << int(rng.integers(8))
        else:
            copy[at : at + 1] = rng.bytes(1)
    return bytes(copy)


def damage_text(text: str, rng: np.random.Generator, names: Sequence[str] = ()) -> bytes:
    """Return a copy of a text with other words, lines or brackets.

    - `names`: files and addresses that must not be opened, put in for words.
    """
    for _ in range(rng.integers(1, 4)):
        lines = text.splitlines(keepends=True) or [""]
        kind, at = rng.integers(6), int(rng.integers(len(lines)))
        if kind == 0:
            del lines[at]
        elif kind == 1:
            lines.insert(int(rng.integers(len(lines) + 1)), lines[at])
        else:
            lines[at] = _replaced(lines[at], rng, [*STRANGE, *names * 6])
        text = "".join(lines)
    return text.encode(errors="surrogatepass")


def _replaced(line: str, rng: np.random.Generator, words: Sequence[str]) -> str:
    found = list(TOKEN.finditer(line))
    if not found:
        return line + words[rng.integers(len(words))]
    token, word = found[rng.integers(len(found))], words[rng.integers(len(words))]
    # Within quotes, so that it stays the value of its key.
    quoted = token[0].startswith('"') and rng.random() < 0.8
    new = '"' + word.replace('"', "'") + '"' if quoted else word
    return line[: token.start()] + new + line[token.end() :]


def beside(path: Path, folder: Path) -> Path:
    """Copy a file and those beside it into a folder; return its path there."""
    folder.mkdir()
    for other in path.parent.iterdir():
        if other.is_file():
            shutil.copy(other, folder)
    return folder / path.name
