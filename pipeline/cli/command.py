"""Typer command class: options with several values, help pages with headings."""

from __future__ import annotations

import functools
import importlib
import re
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import typer
from typer.core import TyperCommand, TyperGroup

from flexroad.pipeline.config.options import HEADINGS

OTHERS = "Options"
RANGES = ((re.compile(r"([\d.]+)<=x<=([\d.]+)"), r"\1 to \2"), (re.compile(r"x>=([\d.]+)"), r"at least \1"))
"""Ranges of numbers as typer writes them, and as our help pages write them."""
MAX_NAME = 30
"""Longest name of an option with its values; the meaning of longer ones starts on the next line."""


class LazyGroup(TyperGroup):
    """A group of commands whose modules are imported only when the command is called."""

    modules: ClassVar[Mapping[str, tuple[str, str]]] = {}
    """The module of each command below `flexroad`, whose `app` has it, and the first line of its help.

    Modules are text, so that the core imports no tool.
    """

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        listed = {name: TyperCommand(name, help=text) for name, (_, text) in self.modules.items()}
        self.commands = {**self.commands, **listed}

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command, None if it does not exist."""
        if cmd_name in self.modules:
            return _imported(self.modules[cmd_name][0], cmd_name)
        return super().get_command(ctx, cmd_name)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the list of commands of the help page, without importing them."""
        TyperGroup(commands=dict(self.commands)).format_commands(ctx, formatter)


@functools.cache
def _imported(module: str, name: str) -> Any:
    found = typer.main.get_group(importlib.import_module(f"flexroad.{module}").app)
    return found if found.name == name else found.commands[name]


def group(
    name: str | None = None, help: str | None = None, cls: type[TyperGroup] | None = None
) -> typer.Typer:
    """Return the object with which a module registers its commands: with a name, a group of the program."""
    return typer.Typer(name=name, help=help, cls=cls, no_args_is_help=True, rich_markup_mode=None)


def _in_words(text: str) -> str:
    """Return the meaning of an option with the range of its numbers in words."""
    for written, words in RANGES:
        text = written.sub(words, text)
    return text


class Command(TyperCommand):
    """A command whose repeatable options take several values: ``--tile a b`` is ``--tile a --tile b``.

    If the command has arguments, they must come first: in ``rerun --tile a b``, b is the run.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the words of a command line."""
        if "--allow" in args:
            ctx.fail("--allow stands before the command: flexroad --allow FOLDER COMMAND ...")
        return super().parse_args(ctx, self._repeated(args))

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the arguments and options of the help page, by their `rich_help_panel`.

        Typer does this only with rich, whose error messages have several lines.
        """
        groups: dict[str, list[tuple[str, str]]] = {}
        for param in self.get_params(ctx):
            if record := param.get_help_record(ctx):
                name, text = record[0], _in_words(record[1])
                if param.param_type_name == "argument":
                    # The type adds nothing to the name.
                    groups.setdefault("Arguments", []).append((name.partition(" <")[0], text))
                else:
                    heading = getattr(param, "rich_help_panel", None) or OTHERS
                    groups.setdefault(heading, []).append((name, text))
        # All groups have one width; longer names have a line of their own.
        lengths = [len(name) for records in groups.values() for name, _ in records]
        width = max((length for length in lengths if length <= MAX_NAME), default=MAX_NAME)
        for heading in sorted(groups, key=["Arguments", *HEADINGS, OTHERS].index):
            with formatter.section(
                heading if len(groups) > 1 + ("Arguments" in groups) or heading == "Arguments" else "Options"
            ):
                formatter.write_dl([(name.ljust(width), text) for name, text in groups[heading]], width)

    def _repeated(self, words: Sequence[str]) -> list[str]:
        if (
            words
            and words[0].startswith("-")
            and any(param.param_type_name == "argument" for param in self.params)
        ):
            return [*words]
        repeatable = {
            name for param in self.params if getattr(param, "multiple", False) for name in param.opts
        }
        out: list[str] = []
        option = ""
        for word in words:
            # Ids of tiles may begin with a minus, as numbers do.
            if word.startswith("-") and not word[1:2].isdigit():
                option = word if word in repeatable else ""
            elif option and out[-1] != option:
                out.append(option)
            out.append(word)
        return out
