"""Fuzzing: damaged and hostile files give a result or one line, never a traceback, a hang or a wrong figure.

``python -m tests.fuzz`` damages valid files of each target for some time and prints what came of it. Tests of
single readers use `check` with a fixed number of files.
"""

from collections.abc import Iterator
from pathlib import Path

from tests.fuzz.damage import beside, damaged
from tests.fuzz.reader import Reader

__all__ = ["check", "damaged"]


def check(module: str, function: str, copies: Iterator[bytes], path: Path) -> None:
    """Assert that reading each copy of ``path`` gives a result or one of the project's errors of one line."""
    results = []
    with Reader(module, function) as reader:
        for number, copy in enumerate(copies):
            file = beside(path, path.parent / f"damaged-{number}")
            file.write_bytes(copy)
            results.append(reader.read(file))
    assert [result for result in results if result.fault] == []
    assert sum(not result.was_read for result in results) > len(results) / 20
