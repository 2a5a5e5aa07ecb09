"""The published results stay true: pages are those of the figures beside them, and prose quotes them."""

import re
from pathlib import Path

import pytest

from flexroad.pipeline.report.content import FIGURES
from flexroad.pipeline.reproduce.metrics_data import FIGURE_DTYPE, FILE, read_metrics_data, write_metrics_data
from flexroad.pipeline.reproduce.tables import pages

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "docs" / "results"
LARGEST_BYTES = 300_000
NUMBER = re.compile(r"(?<![\w.])(?:\d+\.\d+|[+-]\d+%)(?![\w.])")
"""What a reader would take for a result: a decimal, or a signed change in percent."""
QUOTED = re.compile(r"<!-- results -->(.*?)<!-- /results -->", flags=re.DOTALL)


def stale(folder: Path) -> list[str]:
    """Return the pages that are not what the folder's figures give."""
    made = pages(read_metrics_data(folder))
    return [name for name, text in made.items() if (folder / name).read_text() != text]


def unfounded(text: str, folder: Path) -> list[str]:
    """Return the numbers in a text that stand in none of the folder's tables."""
    known = set(NUMBER.findall((folder / "tables.md").read_text()))
    return [number for number in NUMBER.findall(text) if number not in known]


def prose(folder: Path) -> dict[str, str]:
    """Return the texts that quote the tables: pages beside them, and marked parts of README."""
    generated = ("tables.md", "figures.md")
    texts = {page.name: page.read_text() for page in folder.glob("*.md") if page.name not in generated}
    return texts | {"README.md (quoted)": "".join(QUOTED.findall((ROOT / "README.md").read_text()))}


@pytest.mark.skipif(not RESULTS.is_dir(), reason="no results are published yet")
def test_published_results_are_those_of_their_figures():
    assert (RESULTS / FILE).stat().st_size < LARGEST_BYTES
    assert stale(RESULTS) == []
    for name, text in prose(RESULTS).items():
        assert unfounded(text, RESULTS) == [], name


@pytest.fixture
def published(tmp_path):
    """A folder as `flexroad tables` writes it, over tiles with the paper's own figures."""
    import pandas as pd

    from flexroad.pipeline.reproduce.metrics_data import MetricsData
    from flexroad.pipeline.reproduce.published import TABLE_I

    rows = [
        ("made", "segmented", f"t{i}", "", row.variant, *map(row.value, FIGURES))
        for i in range(3)
        for row in TABLE_I
    ]
    keys = ["dataset", "classes", "tile_id", "stratum", "variant"]
    data = MetricsData(
        pd.DataFrame(rows, columns=[*keys, *FIGURES]).astype(dict.fromkeys(FIGURES, FIGURE_DTYPE))
    )
    write_metrics_data(data, tmp_path)
    for name, text in pages(data).items():
        (tmp_path / name).write_text(text)
    return tmp_path


def test_a_page_out_of_date_is_noticed(published):
    assert stale(published) == []
    page = published / "tables.md"
    page.write_text(page.read_text().replace("15.550", "15.551", 1))
    assert stale(published) == ["tables.md"]


def test_figures_out_of_date_are_noticed(published):
    data = read_metrics_data(published)
    data.rows.loc[0, "l2_road_m"] += 0.01
    write_metrics_data(data, published)
    assert "tables.md" in stale(published)


def test_a_number_from_nowhere_is_noticed(published):
    assert unfounded("FlexRoad 0.483 m, RGT 0.415 m, -76%, 0.55 of 24 tiles", published) == ["0.55"]
    assert unfounded("road L2 is 0.999 m", published) == ["0.999"]


def test_the_causes_quote_the_figures_by_quarter():
    import importlib.util

    import pandas as pd

    spec = importlib.util.spec_from_file_location("causes", ROOT / "experiments" / "causes.py")
    causes = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(causes)
    table = causes.by_spoilage(pd.read_parquet(RESULTS / FILE)).grid_55
    text = (ROOT / "docs" / "causes.md").read_text().replace("\n", " ")
    for classes in ("segmented", "reference"):
        *three, last = [f"{change:+.0%}" for change in table[classes]]
        assert f"{', '.join(three)} and {last}" in text, classes
