"""What the commands add to Typer's: several values for one option, and an alarm for a line that is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import typer
from typer.core import TyperCommand

from flexroad.pipeline.cli.lifecycle import unread


class Command(TyperCommand):
    """A command whose repeatable options take several values: ``--tile a b`` is ``--tile a --tile b``.

    Its arguments, if it has any, must come first for that: of ``rerun --tile a b``, b is the run.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the words of a command line."""
        try:
            return super().parse_args(ctx, self._repeated(args))
        except typer.TyperException:
            # With resilient parsing what can be read is read, and nothing raises.
            lenient = {"resilient_parsing": True, "ignore_unknown_options": True}
            readable = self.make_context(ctx.info_name, [*args], ctx.parent, **lenient).params
            if target := readable.get("on_failure"):
                unread(readable.get("out") or readable.get("path"), target)
            raise

    def _repeated(self, words: Sequence[str]) -> list[str]:
        if (
            words
            and words[0].startswith("-")
            and any(one.param_type_name == "argument" for one in self.params)
        ):
            return [*words]
        several = {name for one in self.params if getattr(one, "multiple", False) for name in one.opts}
        out: list[str] = []
        option = ""
        for word in words:
            if word.startswith("-") and not word[1:].isdigit():
                option = word if word in several else ""
            elif option and out[-1] != option:
                out.append(option)
            out.append(word)
        return out
