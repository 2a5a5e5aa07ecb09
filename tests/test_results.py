"""Published results: pages match the metrics file beside them, and texts quote numbers of the tables."""

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
"""A number that looks like a result: a decimal, or a signed change in percent."""
QUOTED = re.compile(r"<!-- results -->(.*?)<!-- /results -->", flags=re.DOTALL)


def stale(folder: Path) -> list[str]:
    """Return the pages that differ from those written from the folder's metrics."""
    expected = pages(read_evidence(folder))
    return [name for name, text in expected.items() if (folder / name).read_text() != text]


def not_in_tables(text: str, folder: Path) -> list[str]:
    """Return the numbers in a text that are in none of the folder's tables."""
    numbers = set(NUMBER.findall((folder / "tables.md").read_text()))
    return [number for number in NUMBER.findall(text) if number not in numbers]


def prose(folder: Path) -> dict[str, str]:
    """Return the texts that quote the tables: pages beside them and marked parts of README, by name."""
    generated = ("tables.md", "figures.md")
    texts = {page.name: page.read_text() for page in folder.glob("*.md") if page.name not in generated}
    return texts | {"README.md (quoted)": "".join(QUOTED.findall((ROOT / "README.md").read_text()))}


@pytest.mark.skipif(not RESULTS.is_dir(), reason="no results are published yet")
def test_published_pages_match_metrics():
    assert (RESULTS / FILE).stat().st_size < LARGEST_BYTES
    assert stale(RESULTS) == []
    for name, text in prose(RESULTS).items():
        assert not_in_tables(text, RESULTS) == [], name


@pytest.fixture
def published(tmp_path):
    """A folder as `flexroad tables` writes it, of tiles with the values of the paper."""
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


def test_stale_page_changed_is_listed(published):
    assert stale(published) == []
    page = published / "tables.md"
    page.write_text(page.read_text().replace("15.550", "15.551", 1))
    assert stale(published) == ["tables.md"]


def test_stale_metrics_changed_lists_pages(published):
    evidence = read_evidence(published)
    evidence.rows.loc[0, "l2_road_m"] += 0.01
    write_evidence(evidence, published)
    assert "tables.md" in stale(published)


def test_not_in_tables_other_number_is_listed(published):
    assert not_in_tables("FlexRoad 0.483 m, RGT 0.415 m, -76%, 0.55 of 24 tiles", published) == ["0.55"]
    assert not_in_tables("road L2 is 0.999 m", published) == ["0.999"]


def test_docs_causes_quotes_changes_by_quarter():
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
