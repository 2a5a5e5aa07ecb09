"""Run the commands of a docs page, and read its tables and the tables of a report."""

import subprocess
import sys

CALL = [sys.executable, "-c", "from flexroad.pipeline.cli.main import main; main()"]


def table_after(text: str, start: str) -> list[tuple[str, list[float]]]:
    """The first table after a string: method and values per row."""
    lines = text[text.index(start) :].splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("| method"))
    rows = []
    for line in lines[first + 2 :]:
        if not line.startswith("|"):
            break
        name, *values = [cell.strip() for cell in line.strip("| ").split("|")]
        rows.append((name, [float(value.replace(",", "")) for value in values]))
    return rows


def flexroad(arguments, folder) -> str:
    """Run a command; return what it printed."""
    result = subprocess.run([*CALL, *arguments], cwd=folder, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def measured(run, folder) -> list[tuple[str, list[float]]]:
    """The main table of a run's report."""
    flexroad(["report", run], folder)
    return table_after((folder / run / "report.md").read_text(), "## Mean over tiles")
