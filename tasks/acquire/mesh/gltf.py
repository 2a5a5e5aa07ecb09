"""Sizes of a glTF file, from its JSON alone, before the arrays that it describes are made."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

MAGIC = b"glTF"
MOST_NODES = 100_000
"""Largest number of nodes and of primitives: trimesh makes an object of each."""
DEEPEST = 100
"""Largest number of levels of nodes: the place of each is the product of those above it."""


def elements(path: Path) -> int:
    """Return the number of vertices and indices that reading a file makes, each instance counted.

    Raises
    ------
    Exception
        Of many types, if the file is damaged.
    """
    header = _header(path)
    counts: list[int] = [_count(accessor) for accessor in header.get("accessors", [])]
    # Accessors without a view have no bytes in the file; they are filled with zeros.
    bare = sum(_count(accessor) for accessor in header.get("accessors", []) if "bufferView" not in accessor)
    meshes = [mesh["primitives"] for mesh in header.get("meshes", [])]
    nodes = header.get("nodes", [])
    if max(len(nodes), sum(map(len, meshes))) > MOST_NODES:
        raise ValueError(f"it has more than {MOST_NODES:,} nodes or primitives")
    _check_graph(nodes)
    sizes: list[int] = [sum(_primitive(part, counts) for part in parts) for parts in meshes]
    placed = sum(sizes[int(node["mesh"])] for node in nodes if "mesh" in node)
    return bare + sum(sizes) + placed


def _header(path: Path) -> dict[str, Any]:
    with path.open("rb") as file:
        head = file.read(20)
        if head[:4] != MAGIC:
            file.seek(0)
            content = file.read()
        else:
            content = file.read(int.from_bytes(head[12:16], "little"))
    header = json.loads(content)
    if not isinstance(header, dict):
        raise TypeError("its JSON is not an object")
    return header


def _count(accessor: dict[str, Any]) -> int:
    count = accessor["count"]
    if not isinstance(count, int) or count < 0:
        raise ValueError(f"an accessor has {str(count)[:50]} elements")
    return count


def _primitive(part: dict[str, Any], counts: list[int]) -> int:
    used = [*part.get("attributes", {}).values(), *([part["indices"]] if "indices" in part else [])]
    return sum(counts[index] for index in used)


def _check_graph(nodes: list[dict[str, Any]]) -> None:
    """Check that the nodes are trees: each has at most one parent, and is at most `DEEPEST` below a root."""
    children = [list(node.get("children", [])) for node in nodes]
    named = [child for each in children for child in each]
    if len(set(named)) < len(named) or not set(named) <= set(range(len(nodes))):
        raise ValueError("it has nodes that have two parents, or do not exist")
    level, reached = sorted(set(range(len(nodes))) - set(named)), 0
    for _ in range(DEEPEST):
        reached += len(level)
        level = [child for node in level for child in children[node]]
    if reached < len(nodes):
        raise ValueError(f"it has nodes below themselves, or more than {DEEPEST} levels of nodes")
