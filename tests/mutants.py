"""Small faults put into the source, and the tests that find them: ``python -m tests.mutants sample|run``.

``sample`` chooses places by a seed and writes ``tests/mutants.csv``. ``run`` puts one fault after the other
into a copy of the last commit, runs the tests of its area there and records the test that failed in the
column ``killed_by``. With ``--again`` only faults that were found before are tried, with that test first.
"""

import argparse
import ast
import csv
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).parent.parent
LIST = ROOT / "tests" / "mutants.csv"
STAGES = tuple(f"tasks/{name}" for name in ("filter", "fit", "spline", "meshing", "segment", "metrics"))
RUN = tuple(f"pipeline/{name}" for name in ("graph", "worker", "store", "run"))
TIMEOUT_S = 600

SWAPPED: dict[type[ast.AST], str] = {
    ast.Lt: "<=",
    ast.LtE: "<",
    ast.Gt: ">=",
    ast.GtE: ">",
    ast.Eq: "!=",
    ast.NotEq: "==",
    ast.Is: "is not",
    ast.IsNot: "is",
    ast.In: "not in",
    ast.NotIn: "in",
    ast.Add: "-",
    ast.Sub: "+",
    ast.Mult: "/",
    ast.Div: "*",
    ast.FloorDiv: "/",
    ast.Pow: "*",
    ast.BitAnd: "|",
    ast.BitOr: "&",
    ast.And: "or",
    ast.Or: "and",
}
SIGN = re.compile(rb"(not in|is not|in|is|and|or|\*\*|//|[<>=!]=|[-+*/<>&|])(?=[\s(]|\w|-|$)")

SKIPPED = (ast.Raise, ast.JoinedStr, ast.AnnAssign, ast.arg, ast.Import, ast.ImportFrom)
"""Messages and types are not changed."""


class Mutant(NamedTuple):
    """One changed expression. ``number`` counts equal expressions of the function that change alike."""

    path: str
    function: str
    before: str
    after: str
    number: int
    killed_by: str = ""


class Place(NamedTuple):
    """Where an expression stands in a file (in bytes), and what replaces it."""

    start: int
    end: int
    after: str


class Source:
    """A source file and the changes that can be made in it."""

    def __init__(self, path: Path) -> None:
        self.text = path.read_bytes()
        lengths = [len(line) for line in self.text.splitlines(keepends=True)]
        self._starts = [0, *accumulate(lengths)]

    def places(self) -> Iterator[tuple[str, Place]]:
        """Yield the changes inside functions, with the name of the function."""
        yield from self._below(ast.parse(self.text), "")

    def _below(self, node: ast.AST, function: str) -> Iterator[tuple[str, Place]]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, SKIPPED) or child is getattr(node, "returns", None):
                continue
            if function:
                yield from ((function, place) for place in (*self._operators(child), *self._values(child)))
            named = isinstance(child, ast.FunctionDef | ast.ClassDef)
            yield from self._below(child, f"{function}.{child.name}".lstrip(".") if named else function)

    def _operators(self, node: ast.AST) -> Iterator[Place]:
        match node:
            case ast.Compare():
                terms = pairwise([node.left, *node.comparators])
                yield from (self._between(*two, sign) for two, sign in zip(terms, node.ops, strict=True))
            case ast.BinOp() if type(node.op) in SWAPPED:
                yield self._between(node.left, node.right, node.op)
            case ast.BoolOp():
                yield from (self._between(*two, node.op) for two in pairwise(node.values))
            case ast.UnaryOp(op=ast.Not() | ast.USub()):
                yield Place(*self._span(node), f"({ast.unparse(node.operand)})")

    def _values(self, node: ast.AST) -> Iterator[Place]:
        match node:
            case ast.Constant(value=bool(value)):
                yield Place(*self._span(node), repr(not value))
            case ast.Constant(value=int(value) | float(value)):
                yield Place(*self._span(node), repr(value + 1))
            case ast.If() | ast.IfExp() | ast.While():
                yield Place(*self._span(node.test), f"(not ({ast.unparse(node.test)}))")
            case ast.Return(value=ast.expr()):
                yield Place(*self._span(node), "return None")
            case ast.Expr(value=ast.Call()):
                yield Place(*self._span(node), "pass")

    def _between(self, left: ast.expr, right: ast.expr, operator: ast.AST) -> Place:
        """Swap the operator between two terms."""
        (start, gap), (rest, end) = self._span(left), self._span(right)
        swapped = SIGN.sub(SWAPPED[type(operator)].encode(), self.text[gap:rest], count=1)
        return Place(start, end, (self.text[start:gap] + swapped + self.text[rest:end]).decode())

    def _span(self, node: Any) -> tuple[int, int]:
        start = self._starts[node.lineno - 1] + node.col_offset
        return start, self._starts[node.end_lineno - 1] + node.end_col_offset


def mutants(path: str) -> dict[Mutant, Place]:
    """Return all mutants of a file and where they are."""
    source = Source(ROOT / path)
    found: dict[Mutant, Place] = {}
    for function, place in source.places():
        mutant = Mutant(path, function, source.text[place.start : place.end].decode(), place.after, 0)
        while mutant in found:
            mutant = mutant._replace(number=mutant.number + 1)
        if mutant.before != mutant.after:
            found[mutant] = place
    return found


def sample(count: int, seed: int) -> list[Mutant]:
    folders = [ROOT / folder for folder in STAGES + RUN]
    files = sorted(file for folder in folders for file in folder.rglob("*.py"))
    every = [mutant for file in files for mutant in mutants(file.relative_to(ROOT).as_posix())]
    return sorted(random.Random(seed).sample(every, count))


def tests_of(path: str) -> list[str]:
    """Return the tests of a file's area, nearest first."""
    folder = "/".join(path.split("/")[:2])
    areas = [folder, *(other for other in RUN if other != folder)] if folder in RUN else [folder]
    return [f"tests/{area}" for area in areas if (ROOT / "tests" / area).is_dir()]


class Copy:
    """A copy of the last commit, whose compiled functions follow the file that is changed."""

    def __init__(self, folder: Path) -> None:
        self.root, self.pristine = folder / "copy", folder / "pristine"
        subprocess.run(["git", "clone", "--quiet", ROOT, self.pristine], check=True)

    def compile(self, areas: list[str]) -> None:
        """Run the tests once, so that all functions are compiled; raise if a test fails."""
        if failed := self.failed(areas, self.pristine):
            raise SystemExit(f"without any fault this test fails: {failed}")
        shutil.copytree(self.pristine, self.root, symlinks=True)

    def failed(self, tests: list[str], root: Path | None = None) -> str:
        """Return the first test that fails, ``timeout``, or nothing."""
        root = root or self.root
        options = ["-q", "-x", "-n0", "-m", "not slow", "-p", "no:cacheprovider", "--no-header"]
        command = [sys.executable, "-m", "pytest", *options, *tests]
        environment = os.environ | {"PYTHONPATH": str(root)}
        try:
            done = subprocess.run(
                command, cwd=root, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S
            )
        except subprocess.TimeoutExpired:
            return "timeout"
        named = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
        return named[1] if named else "" if done.returncode == 0 else f"exit code {done.returncode}"

    def try_mutant(self, mutant: Mutant, place: Place, tests: list[str]) -> str:
        """Return the test that finds a mutant."""
        source = (self.pristine / mutant.path).read_bytes()
        target = self.root / mutant.path
        target.write_bytes(source[: place.start] + place.after.encode() + source[place.end :])
        compiled = self.compiled_with(mutant.path)
        for file in compiled:
            (self.root / file).unlink(missing_ok=True)
        try:
            return self.failed(tests)
        finally:
            shutil.copy2(self.pristine / mutant.path, target)
            for file in compiled:
                shutil.copy2(self.pristine / file, self.root / file)

    def compiled_with(self, path: str) -> list[Path]:
        """Return the files with compiled functions that may contain a function of a source file.

        numba compiles a function again if its own file changes, but not if a function that it calls does.
        """
        changed = self.compiled_of(path)
        if not changed:
            return []
        files = [file.relative_to(self.pristine).as_posix() for file in self.pristine.glob("tasks/**/*.py")]
        importers: set[str] = set()
        found = {path}
        while found:
            importers |= found
            modules = "|".join(re.escape("flexroad." + name[:-3].replace("/", ".")) for name in found)
            names = re.compile(rf"from (?:{modules}) import")
            found = {f for f in files if f not in importers and names.search((self.pristine / f).read_text())}
        return [file for name in importers for file in self.compiled_of(name)]

    def compiled_of(self, path: str) -> list[Path]:
        source = self.pristine / path
        caches = (source.parent / "__pycache__").glob(f"{source.stem}.*.nb[ic]")
        return [file.relative_to(self.pristine) for file in caches]


def read() -> list[Mutant]:
    with LIST.open(newline="") as file:
        return [Mutant(*row[:4], int(row[4]), row[5]) for row in list(csv.reader(file))[1:]]


def write(rows: list[Mutant]) -> None:
    with LIST.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerows([Mutant._fields, *sorted(rows)])


def run(rows: list[Mutant], again: bool) -> None:
    """Try mutants, write which tests found them, and print each."""
    results = {row: row for row in rows}
    tried = [row for row in rows if row.killed_by or not again]
    with tempfile.TemporaryDirectory() as folder:
        copy = Copy(Path(folder))
        copy.compile(sorted({test for row in tried for test in tests_of(row.path)}))
        for row in tried:
            place = mutants(row.path).get(row._replace(killed_by=""))
            if place is None:
                print(f"gone: {row}", flush=True)
                del results[row]
                continue
            killed_by = (
                copy.try_mutant(row, place, [row.killed_by]) if again and "::" in row.killed_by else ""
            )
            if not killed_by.startswith("tests/"):
                killed_by = copy.try_mutant(row, place, tests_of(row.path))
            results[row] = row._replace(killed_by=killed_by)
            print(f"{killed_by or 'LIVES'}: {row}", flush=True)
            write([*results.values()])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("action", choices=("sample", "run"))
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--again", action="store_true", help="only faults that were found before")
    options = parser.parse_args()
    if options.action == "sample":
        write(sample(options.count, options.seed))
    else:
        run(read(), options.again)


if __name__ == "__main__":
    main()
