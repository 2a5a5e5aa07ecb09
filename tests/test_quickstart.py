"""Each quick start: its commands, on synthetic data, end with a map, meshes that open, and a report."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import rasterio
import trimesh

from tests.command_line import call
from tests.make_downloads import DOWNLOADS

PAGE = Path(__file__).parents[1] / "docs" / "quickstart.md"
CATALOGS = ("catalog", "prepare")
SERIAL = ("--executor", "serial")
"""Added for most small areas, whose tiles take less time than the start of workers."""


def quick_starts() -> dict[str, list[list[str]]]:
    """Return the commands of each section by the folder of downloads that it begins with."""
    sections = PAGE.read_text().split("\n## ")[1:]
    blocks = [re.findall(r"^\$ flexroad (.*)$", section, flags=re.MULTILINE) for section in sections]
    commands = [[shlex.split(line) for line in lines] for lines in blocks]
    return {lines[0][1]: lines for lines in commands if lines[0][0] == "init"}


def test_page_has_a_section_per_download():
    assert sorted(quick_starts()) == sorted(DOWNLOADS)


@pytest.mark.slow
@pytest.mark.parametrize("folder", DOWNLOADS)
def test_quick_start_ends_with_map_meshes_and_report(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    DOWNLOADS[folder](tmp_path / folder)
    proposed = looked = ""
    for words in quick_starts()[folder]:
        if words[0] in CATALOGS:
            options = [word for word in words if "*" in word or word == "--reproject"]
            assert [word for word in (*words[1:3], *options) if word not in looked] == []
            words = [*words, "--tile-size", "60"]
        if "run" in words:
            assert shlex.join(words) == proposed, "the page shows another command than the program"
            out = tmp_path / words[words.index("--out") + 1]
            words = [*words, *SERIAL] if folder != "raster_city" else words
        said = call(*words).expected(0)
        if words[0] == "init":
            looked = said.out
        if words[0] in CATALOGS:
            proposed = said.out.splitlines()[-1].removeprefix("next: flexroad ").replace(f"{tmp_path}/", "")
    with rasterio.open(out / "height.vrt") as height:
        assert height.crs.to_epsg() in (25832, 32632)
        values = height.read(1, masked=True)
        assert values.mask.mean() < 0.5
        assert 90 < values.mean() < 170
    assert np.isfinite(values.compressed()).all()
    meshes = sorted(out.glob("tiles/*/*.glb"))
    assert meshes
    for file in meshes:
        assert trimesh.load(file, force="mesh").area > 1000, "in m2"
    assert "<img" in (out / "report.html").read_text()
