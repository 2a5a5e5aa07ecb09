"""The README's tables on real data can be had again by the commands it shows."""

import shlex
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

README = Path(__file__).parents[2] / "README.md"
pytestmark = pytest.mark.real


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


@pytest.mark.parametrize("name", ["barbican", "gothenburg"])
def test_commands_give_the_table(name, real_data, tmp_path):
    for archive in ("London_BNG", "Goteborg_SWEREF99_1200"):
        zipfile.ZipFile(real_data / "umep" / f"{archive}.zip").extractall(tmp_path / "umep")
    text = README.read_text()
    commands = [line for line in text.splitlines() if line.startswith("flexroad ") and name in line]
    assert len(commands) >= 2
    for line in commands[:2]:
        call = [sys.executable, "-c", "from pipeline.cli import main; main()", *shlex.split(line)[1:]]
        subprocess.run(call, cwd=tmp_path, check=True, capture_output=True)
    call = [sys.executable, "-c", "from pipeline.cli import main; main()", "report", f"runs/{name}"]
    subprocess.run(call, cwd=tmp_path, check=True, capture_output=True)
    ours = table_after((tmp_path / "runs" / name / "report.md").read_text(), "## Mean over tiles")
    shown = table_after(text, commands[1])
    assert [row[0] for row in shown] == ["plane", "rgt", "flexroad"]
    for (method, want), (_, got) in zip(shown, ours, strict=True):
        assert got == pytest.approx(want, abs=0.0015, rel=1e-3), method
