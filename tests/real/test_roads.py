"""docs/export.md on real data: the commands along roads print what the page shows."""

import csv
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

from tests.read_opendrive import quality_issues
from tests.real.shown import flexroad

DOCS = Path(__file__).parents[2] / "docs"
RUN = "runs/autzen_roads"
pytestmark = [pytest.mark.real, pytest.mark.slow]


@pytest.fixture(scope="module")
def shown() -> tuple[list[str], list[str]]:
    """The page's commands on Autzen, and the lines below."""
    (block,) = re.findall(
        rf"```console\n(\$ flexroad run [^`]*{RUN}[^`]*)```", (DOCS / "export.md").read_text()
    )
    lines = block.splitlines()
    return [line[2:] for line in lines if line[0] == "$"], [line for line in lines if line[0] != "$"]


@pytest.fixture(scope="module")
def printed(real_data, shown, tmp_path_factory) -> tuple[Path, list[str]]:
    """The folder in which the commands have run, and what the last one has printed."""
    folder = tmp_path_factory.mktemp("roads")
    (folder / "autzen").symlink_to(real_data / "autzen")
    page = (DOCS / "acquisition.md").read_text()
    (prepare,) = re.findall(r"^flexroad prepare .* -o data/autzen$", page, flags=re.MULTILINE)
    for command in (prepare, *shown[0]):
        said = flexroad(shlex.split(command)[1:], folder)
    return folder / "delivery", said.splitlines()


def test_export_prints_the_lines_of_the_page(shown, printed):
    assert [line for line in printed[1] if line.startswith(("crg", "xodr", "lines", "  "))] == shown[1]


def test_errors_of_opencrg_are_those_of_the_page(printed):
    with (printed[0] / "crg" / "roads.csv").open() as file:
        rows = list(csv.DictReader(file))
    largest = np.array([float(row["crg_max_mm"]) for row in rows])
    medians = [float(row["crg_median_mm"]) for row in rows]
    assert ((largest > 2).sum(), len(rows)) == (1, 36)
    assert (round(min(medians), 2), round(max(medians), 2)) == (0.02, 0.16)


def test_opendrive_has_no_issue(printed, tmp_path):
    file = shutil.copy(next((printed[0] / "xodr").glob("*.xodr")), tmp_path / "roads.xodr")
    assert quality_issues(file) == []
