"""The commands of docs/results/real_data.md on rasters of two cities give its tables."""

import shlex
import zipfile
from pathlib import Path

import pytest

from tests.real.shown import flexroad, measured, table_after

PAGE = Path(__file__).parents[2] / "docs" / "results" / "real_data.md"
pytestmark = [pytest.mark.real, pytest.mark.slow]


@pytest.mark.parametrize("name", ["barbican", "gothenburg"])
def test_commands_give_table_of_page(name, real_data, tmp_path):
    for archive in ("London_BNG", "Goteborg_SWEREF99_1200"):
        zipfile.ZipFile(real_data / "umep" / f"{archive}.zip").extractall(tmp_path / "umep")
    text = PAGE.read_text()
    commands = [line for line in text.splitlines() if line.startswith("flexroad ") and name in line]
    assert len(commands) >= 2
    for line in commands[:2]:
        flexroad(shlex.split(line)[1:], tmp_path)
    shown = table_after(text, commands[1])
    assert [row[0] for row in shown] == ["plane", "rgt", "flexroad"]
    for (method, expected), (_, actual) in zip(shown, measured(f"runs/{name}", tmp_path), strict=True):
        assert actual == pytest.approx(expected, abs=0.0015, rel=1e-3), method
