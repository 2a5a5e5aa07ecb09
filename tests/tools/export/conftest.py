"""A small run for tests of exports: of four tiles, two are finished, one has failed, one was never tried."""

import dataclasses
import shutil
from pathlib import Path

import pytest

from flexroad.catalog import Catalog
from flexroad.pipeline.config.loading import compose
from flexroad.pipeline.execute import SerialExecutor
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.run.runner import run_tiles
from flexroad.tools.export.driver import export
from flexroad.tools.export.formats import FORMATS
from flexroad.tools.export.georeference import Datum
from flexroad.tools.export.source import Options, select
from flexroad.tools.synthetic.scenes import write_scenes

CONFIG = {
    "fit": {"method": "nurbs", "control_points": [8, 8], "iterations": 3},
    "variants": {"flexroad": {}},
    "export": {"variants": ["flexroad"], "formats": ["glb"]},
}
OPTIONS = Options(Datum("offset", "47.5"))


@dataclasses.dataclass(frozen=True)
class SmallCity:
    """The folder of a run, and the ids of its tiles."""

    path: Path
    done: tuple[str, str]
    failed: str
    pending: str

    @property
    def survey(self) -> Path:
        """The folder of the source files."""
        return self.path.parent / "survey"


@pytest.fixture(scope="session")
def made_city(tmp_path_factory) -> SmallCity:
    """The run; tests do not change it."""
    folder = tmp_path_factory.mktemp("city")
    catalog = Catalog.read(write_scenes(folder / "survey", 4, seed=0, size_m=60, dop=True))
    broken = folder / "survey" / "dsm" / f"{catalog.tiles[2].id}.tif"
    broken.write_bytes(broken.read_bytes()[:100])
    return run_city(folder)


@pytest.fixture(scope="session")
def whole(made_city, tmp_path_factory) -> Path:
    """An export in all formats, one after the other: OpenDRIVE refers to OpenCRG files of the same export."""
    out, source = tmp_path_factory.mktemp("whole"), select(made_city.path)
    for name in FORMATS:
        export(source, out, [name], OPTIONS, SerialExecutor())
    return out


@pytest.fixture
def own_city(made_city, tmp_path) -> SmallCity:
    """A run for one test, which may change it."""
    shutil.copytree(made_city.survey, tmp_path / "own" / "survey")
    return run_city(tmp_path / "own")


def run_city(folder: Path) -> SmallCity:
    catalog = Catalog.read(folder / "survey" / "catalog.parquet")
    first, second, third, fourth = (tile.id for tile in catalog.tiles)
    run = Run.create(folder / "city", compose(CONFIG, "small"), catalog)
    summary = run_tiles(run, SerialExecutor(), only=lambda tile: tile.id != fourth)
    assert (summary.done, summary.failed) == (2, 1)
    return SmallCity(run.path, (first, second), third, fourth)


def contents(folder: Path) -> dict[str, bytes]:
    """The files of an export by name, without its manifest and the hidden ones."""
    files = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    shown = [path for path in files if not any(part.startswith(".") for part in path.parts)]
    return {str(path): (folder / path).read_bytes() for path in shown if path.name != "export.json"}
