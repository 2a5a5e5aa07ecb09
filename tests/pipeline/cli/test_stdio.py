"""Printing of lines: nothing that a file holds reaches the terminal as a control character."""

from pathlib import Path

from flexroad.pipeline.cli.stdio import echo, echo_document
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.progress import ProgressDisplay
from tests.command_line import call

CLI = Path(__file__).parents[3] / "pipeline" / "cli"


def test_echo_escapes_control_characters(capsys):
    echo("failed \x1b[2Ja\r\n\u202eb", err=True)
    echo_document("one\x1b\ntwo\n")
    said = capsys.readouterr()
    assert said.err == "failed \\x1b[2Ja\\r\\n\\u202eb\n"
    assert said.out == "one\\x1b\ntwo\n"


def test_commands_print_with_echo_only():
    """The streams' module is the one place where characters are escaped."""
    others = [path for path in CLI.glob("*.py") if path.name != "stdio.py"]
    assert not [path for path in others if any(word in path.read_text() for word in ("typer.echo", "print("))]


def test_error_line_is_escaped(monkeypatch):
    def fail():
        raise ConfigError("a\x1b[2Jb\nc")

    monkeypatch.setattr("flexroad.pipeline.cli.main.app", fail)
    assert call("run").expected(2).err == "error: a\\x1b[2Jb\nerror: c\n"


def test_progress_lines_are_escaped():
    import io

    from rich.console import Console

    out = io.StringIO()
    ProgressDisplay(1, Console(file=out)).say("failed a\x1b[2J\n[bold]b")
    assert out.getvalue() == "failed a\\x1b[2J\\n[bold]b\n"
