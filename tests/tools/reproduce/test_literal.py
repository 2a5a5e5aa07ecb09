"""The second column of the tables: the paper read literally."""

from dataclasses import replace

import pandas as pd

from flexroad.tools.report.content import FIGURES
from flexroad.tools.reproduce.metrics_data import FIGURE_DTYPE, MetricsData, write_metrics_data
from flexroad.tools.reproduce.published import TABLE_I, TABLE_II, published
from flexroad.tools.reproduce.tables import compare, pages
from tests.stored_metrics import read_metrics_data

VARIANTS = [row.variant for row in (*TABLE_II, *TABLE_I[:2])]


def as_published(tiles: int = 3) -> MetricsData:
    """Return tiles whose figures equal the paper's."""
    rows = [
        ("made", "segmented", f"t{i}", "urban", name, *map(published(name).value, FIGURES))
        for i in range(tiles)
        for name in VARIANTS
    ]
    return MetricsData(
        pd.DataFrame(rows, columns=["dataset", "classes", "tile_id", "stratum", "variant", *FIGURES])
    )


def test_compare_with_literal_run_adds_column_and_factors():
    data = as_published(4)
    literal = MetricsData(data.rows[data.rows.tile_id.isin(["t0", "t1"])].copy())
    literal.rows.loc[literal.rows.variant == "wo_dtm", ["l2_road_m", "l2_terrain_m"]] *= 16
    # Ours differs on tiles that the literal run lacks: these do not count.
    data.rows.loc[(data.rows.tile_id == "t3") & (data.rows.variant == "wo_dtm"), "l2_road_m"] *= 100
    comparison = compare(replace(data, literal=literal))
    sections = {title: (table, line) for title, table, line in comparison.sections}
    table = sections["Table II: L2"][0].set_index("variant")
    assert table.at["w/o DTM Support", "L2 road (m), literal (2 tiles)"].startswith("9.344 [")
    factors = sections["Table II: factors from the paper"][0].set_index("variant")
    # Two of the row's four figures are 16 times the paper's: the mean factor is 16 to the power of a half.
    assert factors.loc["w/o DTM Support"].tolist() == ["1.00", "4.00", "1.00", "4.00"]
    assert factors.at["all", "figures, literal"] == f"{4 ** (1 / 19):.2f}"
    assert "2 tiles" in sections["Table II: factors from the paper"][1]
    assert comparison.numbers.data.str.endswith("; read literally").sum() == (3 + 19) * len(FIGURES)


def test_pages_with_literal_run_are_those_of_the_stored_figures(tmp_path):
    main = MetricsData(as_published().rows.astype(dict.fromkeys(FIGURES, FIGURE_DTYPE)))
    data = replace(main, literal=main)
    write_metrics_data(data, tmp_path)
    assert pages(read_metrics_data(tmp_path)) == pages(data)
    assert "ours | L2 road (m), literal |" in pages(data)["tables.md"]
    write_metrics_data(main, tmp_path)
    assert read_metrics_data(tmp_path).literal is None
