"""Print how large the project is: lines, files, public classes, words of the docs, options, parameters.

Only files that git tracks are counted. A public class is at the top level of a module, without a leading
underscore.
"""

from __future__ import annotations

import ast
import subprocess
from pathlib import Path
from typing import Any

import typer

from flexroad.pipeline.cli.configs import schema
from flexroad.pipeline.cli.main import app

ROOT = Path(__file__).parents[1]
CORE = ("catalog", "tasks", "pipeline", "flexroad")
TOOLS = sorted(folder.name for folder in (ROOT / "tools").iterdir() if (folder / "__init__.py").is_file())


def tracked(*patterns: str) -> list[Path]:
    """Return the tracked files below the folders, or of the names."""
    command = ["git", "ls-files", "-z", "--", *patterns]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [ROOT / name for name in names.split("\0") if name and not (ROOT / name).is_symlink()]


def lines(files: list[Path]) -> int:
    return sum(len(file.read_text().splitlines()) for file in files)


def words(files: list[Path]) -> int:
    return sum(len(file.read_text().split()) for file in files)


def inner_imports(tree: ast.Module) -> int:
    """Return the number of imports inside the functions of a module."""
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    inside = {node for function in functions for node in ast.walk(function)}
    return sum(isinstance(node, ast.Import | ast.ImportFrom) for node in inside)


def keys(node: Any) -> set[str]:
    """Return the keys that a JSON schema names, including keys of its definitions."""
    if isinstance(node, list):
        return {key for item in node for key in keys(item)}
    if not isinstance(node, dict):
        return set()
    return {*node.get("properties", {})} | keys([*node.values()])


def configuration_keys() -> int:
    """Return the number of keys of a configuration; a key of several methods of a section is counted once."""
    sections = schema()["properties"]
    inner = [keys(part) for section, part in sections.items() if section != "variants"]
    return len(sections) + sum(map(len, inner))


def parameters(command: Any) -> list[str]:
    """Return the names of the options and arguments of a command and its subcommands, without ``--help``."""
    own = [parameter.name for parameter in command.params if parameter.name != "help"]
    names = command.list_commands(None) if hasattr(command, "list_commands") else ()
    return [*own, *(name for inner in names for name in parameters(command.get_command(None, inner)))]


def main() -> None:
    core, tools = (
        [file for file in tracked(*folders) if file.suffix == ".py"] for folders in (CORE, ["tools"])
    )
    source = core + tools
    tests = [file for file in tracked("tests", "bench") if file.suffix == ".py"]
    trees = [ast.parse(file.read_text()) for file in source]
    classes = [node.name for tree in trees for node in tree.body if isinstance(node, ast.ClassDef)]
    pages = [file for file in tracked("docs") if file.suffix == ".md"]
    live = [file for file in pages if "results" not in file.parts]
    names = parameters(typer.main.get_command(app))
    figures = {
        "core: lines of Python": lines(core),
        "tools: lines of Python": lines(tools),
        "source: files": len(source),
        "source: public classes": sum(not name.startswith("_") for name in classes),
        "source: imports in functions": sum(map(inner_imports, trees)),
        "tests, bench: lines of Python": lines(tests),
        "tests, bench: files": len(tests),
        "README: lines": lines([ROOT / "README.md"]),
        "configuration keys": configuration_keys(),
        "parameters of commands": len(names),
        "parameters: different names": len(set(names)),
        "docs: words": words(live),
        "docs: words of results": words(pages) - words(live),
    }
    for folder in (*CORE[:3], *(f"tools/{name}" for name in TOOLS)):
        figures[f"{folder}: lines"] = lines([file for file in source if file.is_relative_to(ROOT / folder)])
    for name, value in figures.items():
        print(f"{name:32}{value:8,}")


main()
