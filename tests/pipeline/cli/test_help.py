"""Help pages: what each option takes, and under which heading it is."""

import importlib
import re
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any, get_args, get_origin

import pytest
import typer

from flexroad.pipeline.cli.catalogs import TOOLS
from flexroad.pipeline.cli.main import COMMANDS as LISTED
from flexroad.pipeline.cli.main import app
from flexroad.pipeline.config.stages import STAGE_NAMES


def commands(group: Any, words: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    for name in group.commands:
        command = group.get_command(None, name)
        inner = hasattr(command, "commands")
        yield from commands(command, (*words, name)) if inner else [((*words, name), command)]


COMMANDS = dict(commands(typer.main.get_command(app)))


PATHS = {"FILE", "FOLDER", "RUN", "CATALOG", "MODEL"}
METAVARS = {
    int: {"N", "METRES"},
    float: {"METRES", "SHARE", "NUMBER", "PERCENT"},
    Path: PATHS,
    str: {
        "NAME", "NAME|FILE", "ID", "KEY=VALUE", "PATTERN", "CRS", "SQL", "auto|dask|serial|ADDRESS",
        "CRS|FILE|METRES", "FILE", "FILE|'X Y, X Y'", "RUN", "N|all",
    },
    datetime: {"YYYY-MM-DD"},
    tuple: {"W S E N", "E N H", "E N"},
}  # fmt: skip
"""The words for values of options, by the type of the option."""
PACKED = "FOLDER|ZIP"
ARGUMENTS = {"RUN", "CATALOG", "FOLDER", PACKED, "ROOT", "FILE", "INPUT", "NAME|FILE"}


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_help_says_what_each_option_takes_with_the_same_words(words, monkeypatch):
    for param in COMMANDS[words].params:
        if param.param_type_name == "argument":
            assert param.metavar in ARGUMENTS, param.name
        elif param.metavar is not None:
            kind = param.type_descriptor.annotation
            if get_origin(kind) is list:
                (kind,) = get_args(kind)
            assert param.metavar in METAVARS[get_origin(kind) or kind], param.name
        else:
            # A flag has no value, and a choice lists its values.
            assert param.is_flag or "|" in param.display_type_rich(None), param.name
    monkeypatch.setenv("COLUMNS", "80")
    command = COMMANDS[words]
    page = command.get_help(command.make_context(words[-1], [], resilient_parsing=True))
    assert max(map(len, page.splitlines())) <= 80
    assert re.findall(r"<[a-z][\w \[\]]*>", page) == [], "a type of Python instead of a meaning"
    assert "<=" not in page
    assert ">=" not in page


@pytest.mark.parametrize("words", [(), ("catalog",), ("config",)], ids=" ".join)
def test_help_lists_commands_with_whole_sentences(words, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    group = typer.main.get_command(app)
    for word in words:
        group = group.get_command(None, word)
    lines = group.get_help(group.make_context("x", [], resilient_parsing=True)).splitlines()
    listed = lines[lines.index("Commands:") + 1 :]
    assert len(listed) == len(group.commands)
    assert [line for line in listed if line.endswith("...")] == []


def test_help_lists_commands_as_their_own_pages_describe_them():
    group = typer.main.get_command(app)
    listed = {name: command.get_short_help_str(200) for name, command in group.commands.items()}
    assert listed == {name: group.get_command(None, name).get_short_help_str(200) for name in listed}


def test_commands_of_all_modules_are_listed():
    listed = {**LISTED, **TOOLS}
    written = set()
    for name in {module for module, _ in listed.values()}:
        group = typer.main.get_group(importlib.import_module(f"flexroad.{name}").app)
        written |= {group.name} if group.name else set(group.commands)
    assert written == set(listed)


def test_help_lists_options_under_headings():
    command = COMMANDS["run",]
    page = command.get_help(command.make_context("run", [], resilient_parsing=True))
    headings = re.findall(r"^(\w.*):$", page, re.MULTILINE)
    assert headings == ["Inputs", "Tiles", "Outputs", "Parallel work", "Options"]
    assert page.index("Parallel work:") < page.index("--executor auto|dask|serial|ADDRESS")


def test_rerun_from_offers_every_stage():
    (option,) = (param for param in COMMANDS["rerun",].params if "--from" in param.opts)
    assert option.display_type_rich(None) == f"<{'|'.join((*STAGE_NAMES, 'export'))}>"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("run --config paper --catalog c.json --out x --executor x", "dask"),
        ("rerun x --from fitt", "ecsrc"),
        ("report x --format pdf", "html"),
        ("catalog synthetic -o x --preset gero", "gerod"),
    ],
)
def test_option_with_other_value_names_the_valid_ones(flexroad, words, message):
    said = flexroad(*words.split()).expected(2)
    assert f"Invalid value for '{words.split()[-2]}'" in said.err
    assert message in said.err


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("run --tile a b --out x", {"tile": ["a", "b"], "out": Path("x")}),
        # Of tiles west of a CRS's origin the ids begin with a minus.
        ("run --tile -500_250 -750_-250 0_-250", {"tile": ["-500_250", "-750_-250", "0_-250"]}),
        ("catalog rasters root --road-value 1 -3 -o c", {"road_value": [1, -3], "root": Path("root")}),
        ("rerun --tile a RUN", {"tile": ["a"], "path": Path("RUN")}),
    ],
)
def test_repeatable_option_takes_several_values(words, expected):
    split = tuple(words.split())
    name = next(name for name in COMMANDS if split[: len(name)] == name)
    context = COMMANDS[name].make_context(name[-1], [*split[len(name) :]], resilient_parsing=True)
    assert {key: context.params[key] for key in expected} == expected
