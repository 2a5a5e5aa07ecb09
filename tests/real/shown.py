"""Commands and tables that a page shows."""

import subprocess
import sys

CALL = [sys.executable, "-c", "from flexroad.pipeline.cli.main import main; main()"]


def table_after(text: str, start: str) -> list[tuple[str, list[float]]]:
    """The first table after a line: method and figures."""
    lines = text[text.index(start) :].splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("| method"))
    rows = []
    for line in lines[first + 2 :]:
        if not line.startswith("|"):
            break
        name, *figures = [cell.strip() for cell in line.strip("| ").split("|")]
        rows.append((name, [float(figure.replace(",", "")) for figure in figures]))
    return rows


def flexroad(words, folder) -> None:
    done = subprocess.run([*CALL, *words], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def measured(run, folder) -> list[tuple[str, list[float]]]:
    """The main table of a run's report."""
    flexroad(["report", run], folder)
    return table_after((folder / run / "report.md").read_text(), "## Mean over tiles")
