"""Read untrusted YAML: limited in size, time and memory. Repeated keys are errors.

YAML can describe much more than it has bytes (aliases of aliases, merge keys). PyYAML silently takes the last
of equal keys, and its constructors raise many types of errors. Here all of these are a `ConfigError` of one
line with the line number. Messages have no text of the file, which may be a private file given by mistake.
"""

from __future__ import annotations

from typing import Any

import yaml

from flexroad.catalog.text import printable, shown
from flexroad.pipeline.errors import ConfigError

MAX_BYTES = 2**20
"""Largest file; one with all options has 10 KB."""
MAX_VALUES = 20_000
"""Most keys and values, with aliases written out."""
MAX_DEPTH = 20
"""Deepest nesting, with aliases written out; options need 5."""
MAX_NUMBER = 100
"""Most characters of a number: Python takes no decimal numbers above 4,300 digits."""
MAX_REASON = 200


def parse(data: bytes, name: str) -> tuple[Any, dict[str, int]]:
    """Return the content of a YAML file, and the line of each key of its outermost mapping, from 1."""
    if len(data) > MAX_BYTES:
        raise ConfigError(f"{name}: {len(data)} bytes; a configuration has at most {MAX_BYTES}")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ConfigError(f"{name}: line {line} is not in UTF-8; save the file in this encoding") from None
    try:
        return _load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"{name}: not readable as YAML: {_reason(error, text)}") from None


def _load(text: str) -> tuple[Any, dict[str, int]]:
    loader = _Loader(text)
    try:
        root = loader.get_single_node()
        if root is None:
            return None, {}
        # The lines are read before the construction, which adds the entries of merge keys.
        keys = [key for key, _ in root.value] if isinstance(root, yaml.MappingNode) else []
        lines = {key.value: key.start_mark.line + 1 for key in keys if isinstance(key, yaml.ScalarNode)}
        return loader.construct_document(root), lines
    finally:
        loader.dispose()


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader with the limits of this module."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._level = 0
        self._values = 0
        self._sizes: dict[yaml.Node, tuple[int, int]] = {}
        """Number of values and depth of each complete node, with aliases written out."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        """Return the next node."""
        alias = self.check_event(yaml.AliasEvent)
        mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
        self._level += 1
        # The depth is also checked before the children, because each level needs space on the stack.
        self._check(self._level <= MAX_DEPTH, f"nested more than {MAX_DEPTH} deep", mark)
        before = self._values
        node = super().compose_node(parent, index)
        assert node is not None
        if alias:
            self._check(node in self._sizes, "an alias of a value within this value", mark)
            self._values += self._sizes[node][0]
        else:
            self._values += 1
            children = _children(node)
            depth = 1 + max((self._sizes[child][1] for child in children), default=0)
            self._sizes[node] = (self._values - before, depth)
        deepest = self._level - 1 + self._sizes[node][1]
        self._check(deepest <= MAX_DEPTH, f"nested more than {MAX_DEPTH} deep", mark)
        self._check(self._values <= MAX_VALUES, f"more than {MAX_VALUES} values", mark)
        self._level -= 1
        return node

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        """Return the next mapping, whose keys are all different."""
        node = super().compose_mapping_node(anchor)
        seen: dict[str, yaml.Node] = {}
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                first = seen.setdefault(key.value, key)
                problem = f"the key {shown(key.value)} is also in line {first.start_mark.line + 1}"
                self._check(first is key, f"{problem}; remove one of them", key.start_mark)
        return node

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """Return the value of a node."""
        number = node.tag.endswith((":int", ":float"))
        message = f"a number of more than {MAX_NUMBER} characters"
        self._check(not number or len(node.value) <= MAX_NUMBER, message, node.start_mark)
        try:
            return super().construct_object(node, deep)
        except (ValueError, LookupError, AttributeError, TypeError, ArithmeticError):
            kind = printable(node.tag.rpartition(":")[2])[:20]
            problem = f"the value is no {kind}; put a text in quotes"
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark) from None

    def _check(self, fine: bool, problem: str, mark: Any) -> None:
        if not fine:
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=mark)


def _children(node: yaml.Node) -> list[yaml.Node]:
    if isinstance(node, yaml.MappingNode):
        return [part for pair in node.value for part in pair]
    return node.value if isinstance(node, yaml.SequenceNode) else []


def _reason(error: yaml.YAMLError, text: str) -> str:
    """Return line and reason of an error; PyYAML's own text has parts of the file."""
    if isinstance(error, yaml.reader.ReaderError):
        line = text.count("\n", 0, error.position) + 1
        return f"line {line}: the character #x{error.character:04x} is not allowed"
    mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
    problem = getattr(error, "problem", None) or getattr(error, "context", None) or type(error).__name__
    place = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
    return f"{place}{printable(problem)[:MAX_REASON]}"
