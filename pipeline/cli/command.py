"""Typer command class: options with several values, and a notification if the command line is invalid."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from flexroad.pipeline.cli.lifecycle import notify_invalid_command

Allow = Annotated[
    list[str] | None,
    typer.Option(metavar="DIR|URL", help="Allow source files in this folder, too; repeatable."),
]

MIN_COVER_HELP = "Leave out tiles with a DSM height in less than this share of their cells; 0 keeps all."


class Command(TyperCommand):
    """A command whose repeatable options take several values: ``--tile a b`` is ``--tile a --tile b``.

    If the command has arguments, they must come first: in ``rerun --tile a b``, b is the run.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the words of a command line."""
        try:
            return super().parse_args(ctx, self._repeated(args))
        except typer.TyperException:
            # Resilient parsing returns the valid options and raises nothing.
            lenient = {"resilient_parsing": True, "ignore_unknown_options": True}
            params = self.make_context(ctx.info_name, [*args], ctx.parent, **lenient).params
            if target := params.get("on_failure"):
                notify_invalid_command(params.get("out") or params.get("path"), target)
            raise

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
            if word.startswith("-") and not word[1:].isdigit():
                option = word if word in repeatable else ""
            elif option and out[-1] != option:
                out.append(option)
            out.append(word)
        return out
