"""The score of Table II's changes, on tiles whose figures are the paper's."""

import pandas as pd

from flexroad.pipeline.config.loading import load_config
from flexroad.tools.report.content import FIGURES
from flexroad.tools.reproduce.claims import NOT_DECIDED
from flexroad.tools.reproduce.metrics_data import MetricsData
from flexroad.tools.reproduce.published import published
from flexroad.tools.reproduce.tables import compare

VARIANTS = list(load_config("ablation").chains)


def as_published(tiles: int = 3, classes: str = "segmented") -> MetricsData:
    """Return tiles whose figures equal the paper's."""
    rows = [
        ("made", classes, f"t{i}", ("urban", "rural")[i % 2], name, *map(published(name).value, FIGURES))
        for i in range(tiles)
        for name in VARIANTS
    ]
    return MetricsData(
        pd.DataFrame(rows, columns=["dataset", "classes", "tile_id", "stratum", "variant", *FIGURES])
    )


def score(data: MetricsData) -> dict[str, pd.DataFrame]:
    """Return the tables that score the changes of Table II, by their titles."""
    return {title: table for title, table, _ in compare(data).sections if "change" in title}


def test_compare_published_figures_score_all_changes_within():
    tables = score(as_published())
    everything = tables["Table II: how close the changes are"].set_index("figure").loc["all"]
    # Counted by hand in Table II: changes of L2 and MAD by more than 5%.
    assert everything.to_dict() == {
        "changes": "55", "within": "55", "weaker": "0", "stronger": "0", "opposite or flat": "0",
        NOT_DECIDED: "0",
    }  # fmt: skip
    assert "Table II: changes that are opposite or flat" not in tables


def test_compare_lists_changes_of_the_other_sign_with_reason():
    data = as_published()
    data.rows.loc[data.rows.variant == "wo_dynamic", "l2_terrain_m"] = 0.1
    data.rows.loc[data.rows.variant == "grid_55", "mad_road_deg"] = 1.1
    tables = score(data)
    counts = tables["Table II: how close the changes are"].set_index("figure")
    assert counts.at["L2 terrain", "opposite or flat"] == counts.at["all", "opposite or flat"] == "1"
    assert (counts.at["MAD road", "weaker"], counts.at["all", "within"]) == ("1", "53")
    (row,) = tables["Table II: changes that are opposite or flat"].to_dict("records")
    assert (row["variant"], row["paper"], row["ours"]) == ("w/o Dynamic Sampling", "+346%", "-70%")
    assert "sampled at 1 m" in row["reason"]
