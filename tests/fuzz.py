"""Damage files at random and read them in a process of their own: only the project's errors may come.

``python -m tests.fuzz MODULE FUNCTION FILE...`` prints what each file gave, one JSON array per file.
"""

import importlib
import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parent.parent
SECONDS = 10
"""Limit of one file; a file takes milliseconds."""
WORDS = (b"\xff\xff\xff\xff", b"\0\0\0\x80", b"\0\0\0\0", b"\xff\xff\xff\x7f", b"\0\0\xc0\x7f")
"""Largest, smallest and no number, as integers and as floats."""


def damaged(data: bytes, n: int, seed: int) -> Iterator[bytes]:
    """Yield copies of a file with random bytes, with extreme numbers, or cut off."""
    rng = np.random.default_rng(seed)
    for _ in range(n):
        copy, kind = bytearray(data), rng.integers(5)
        if kind == 0:
            yield data[: rng.integers(len(data))]
            continue
        # Headers are short, and most of the checks are about them.
        end = min(len(data), 400) if kind == 1 else len(data)
        for at in rng.integers(end, size=rng.integers(1, 9)):
            copy[at : at + 4] = (
                WORDS[rng.integers(len(WORDS))] if kind == 2 else rng.bytes(1) + copy[at + 1 : at + 4]
            )
        yield bytes(copy)


def check(module: str, function: str, copies: Iterator[bytes], path: Path) -> None:
    """Assert that reading each copy of ``path`` gives a result or one of the project's errors of one line."""
    files = []
    for number, copy in enumerate(copies):
        folder = path.parent / f"damaged-{number}"
        folder.mkdir()
        for beside in path.parent.iterdir():
            if beside.is_file() and beside != path:
                shutil.copy(beside, folder)
        files.append(folder / path.name)
        files[-1].write_bytes(copy)
    done = subprocess.run(
        [sys.executable, "-m", "tests.fuzz", module, function, *files],
        capture_output=True,
        text=True,
        cwd=ROOT,
        timeout=SECONDS * 20,
    )
    results = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.returncode == 0, f"{files[len(results)]}: {done.returncode} {done.stderr[-500:]}"
    assert [result for result in results if result[1] != "read" and result[1] not in OWN] == []
    assert [result for result in results if "\n" in result[2] or len(result[2]) > 2000] == []
    assert sum(result[1] in OWN for result in results) > len(results) / 20


OWN = ("TaskError", "CatalogError", "ConfigError")


def attempt(read: Callable[[Path], object], path: Path) -> tuple[str, str, str]:
    signal.alarm(SECONDS)
    try:
        read(path)
    except Exception as error:
        return str(path), type(error).__name__, str(error)
    finally:
        signal.alarm(0)
    return str(path), "read", ""


if __name__ == "__main__":
    read = getattr(importlib.import_module(sys.argv[1]), sys.argv[2])
    for name in sys.argv[3:]:
        sys.stdout.write(json.dumps(attempt(read, Path(name))) + "\n")
        sys.stdout.flush()
