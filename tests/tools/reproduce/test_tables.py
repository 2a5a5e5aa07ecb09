"""The comparison with the paper: means, intervals, verdicts, and pages that name their data."""

import io
import re
import shutil
import subprocess
from dataclasses import replace
from datetime import UTC, datetime
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
import scipy.stats

from flexroad.catalog import LAYERS, Catalog, Grid, Layer, Tile
from flexroad.catalog.storage.paths import write
from flexroad.pipeline.config.loading import load_config
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.store.tables import metrics_frame
from flexroad.tools.report.content import FIGURES
from flexroad.tools.reproduce.claims import (
    HELD,
    NOT_DECIDED,
    NOT_HELD,
    NOT_TESTED,
    STRONGER,
    WEAKER,
    bootstrap,
    check,
    percent,
)
from flexroad.tools.reproduce.metrics_data import FIGURE_DTYPE, MetricsData, collect, write_metrics_data
from flexroad.tools.reproduce.published import (
    CLAIMS,
    TABLE_I,
    TABLE_I_DSC3D,
    TABLE_II,
    Claim,
    Row,
    published,
)
from flexroad.tools.reproduce.tables import compare, pages, write_comparison
from tests.stored_metrics import read_metrics_data

VARIANTS = list(load_config("ablation").chains)


def figures(values: dict[str, list[float]]) -> pd.DataFrame:
    """Return a table in which every figure of a variant's tile has the given value."""
    rows = [
        (f"t{i}", variant, *[value] * len(FIGURES))
        for variant, tiles in values.items()
        for i, value in enumerate(tiles)
    ]
    return pd.DataFrame(rows, columns=["tile_id", "variant", *FIGURES]).set_index(["tile_id", "variant"])


def of_tiles(tiles: int, table: dict[str, Row], dataset: str = "made") -> MetricsData:
    """Return tiles whose figures equal the rows of a table."""
    rows = [
        (dataset, "segmented", f"t{i}", ("urban", "rural")[i % 2], name, *map(row.value, FIGURES))
        for i in range(tiles)
        for name, row in table.items()
    ]
    frame = pd.DataFrame(rows, columns=["dataset", "classes", "tile_id", "stratum", "variant", *FIGURES])
    return MetricsData(frame)


def as_published(tiles: int = 3) -> MetricsData:
    return of_tiles(tiles, {name: published(name) for name in VARIANTS})


TEXT_AND_TABLE_DIFFER = {"Sampling at 0.5 m / 5 m doubles the triangles (four times in Table II)"}


def test_ablation_config_has_all_rows_of_the_tables():
    assert len(TABLE_II) == 19
    names = [row.variant for row in (*TABLE_I[:2], *TABLE_II)]
    assert names == list(load_config("ablation").chains)


def test_full_pipeline_row_matches_table_i():
    main, full = TABLE_I[-1], TABLE_II[0]
    for figure in FIGURES:
        # Table I rounds triangles to thousands.
        assert main.value(figure) == pytest.approx(full.value(figure), rel=0.02)
    assert published("flexroad") == full


@pytest.mark.parametrize("claim", CLAIMS, ids=lambda claim: claim.text)
def test_claim_matches_the_papers_tables(claim):
    values = [published(name, claim.dataset).value(claim.figure) for name in claim.variants]
    if claim.quoted is None:
        assert all(a <= b for a, b in pairwise(values))
        return
    base, changed = values
    percent = 100 * (changed / base - 1)
    if claim.text in TEXT_AND_TABLE_DIFFER:
        assert abs(percent - claim.quoted) > 100
    elif "doubles" in claim.text:
        assert percent == pytest.approx(claim.quoted, abs=5)
    else:
        assert percent == pytest.approx(claim.quoted, abs=1.0)


def test_tiles_without_roads_are_left_out_of_road_figures_and_counted():
    whole = as_published(4)
    assert "without roads" not in whole.line
    rows = whole.rows.copy()
    rows.loc[rows.tile_id == "t0", ["l2_road_m", "mad_road_deg"]] = np.nan
    part = MetricsData(rows)
    assert part.line == whole.line[:-1] + "; 1 without roads, left out of the figures of roads."
    ours = compare(part).numbers.set_index(["table", "variant", "figure"]).ours
    theirs = compare(whole).numbers.set_index(["table", "variant", "figure"]).ours
    pd.testing.assert_series_equal(ours, theirs)
    assert part.line in pages(part)["tables.md"]


def test_bootstrap_interval_matches_scipy_and_means_ignore_nan():
    means = bootstrap(figures({"a": [1.0, 3.0, np.nan], "b": [2.0, 2.0, 5.0]}))
    assert means.mean["a", "l2_road_m"] == 2
    assert means.ratio("b", "a", "l2_road_m")[0] == 1.5
    values = np.random.default_rng(3).gamma(2, 1, 60)
    low, high = bootstrap(figures({"a": values.tolist()})).interval("a", "l2_road_m")
    peer = scipy.stats.bootstrap((values,), np.mean, method="percentile", n_resamples=20_000, rng=1)
    width = peer.confidence_interval.high - peer.confidence_interval.low
    assert (low, high) == pytest.approx(tuple(peer.confidence_interval), abs=0.05 * width)


def test_bootstrap_ratio_uses_paired_tiles():
    tiles = np.random.default_rng(1).gamma(1, 5, 40)
    ratio, resampled = bootstrap(figures({"a": tiles.tolist(), "b": (2 * tiles).tolist()})).ratio(
        "b", "a", "l2_road_m"
    )
    assert ratio == pytest.approx(2)
    assert resampled == pytest.approx(2)


RISE = Claim("rises", "x", "l2_road_m", ("flexroad", "wo_ecsrc"), 111)


@pytest.mark.parametrize(
    ("ours", "verdict"),
    [
        ([2.1] * 4, HELD),
        ([1.5] * 4, HELD),
        ([4.4] * 4, HELD),
        ([1.4] * 4, WEAKER),
        ([4.5] * 4, STRONGER),
        ([1.0] * 4, NOT_HELD),
        ([0.9] * 4, NOT_HELD),
        # The mean is 2.1, too, but by one tile in four: it is so in few resamples.
        ([0.9, 0.9, 0.9, 5.7], NOT_DECIDED),
    ],
)
def test_check_change_holds_between_half_and_twice_the_papers(ours, verdict):
    # The paper's ratio is 2.114: the square root is 1.454, the square 4.469.
    result = check(RISE, bootstrap(figures({"flexroad": [1.0] * 4, "wo_ecsrc": ours})))
    assert (result.verdict, result.paper, result.ours) == (verdict, "+111%", percent(np.mean(ours)))


@pytest.mark.parametrize(
    ("values", "slack", "verdict", "text"),
    [
        ((1, 2), 0, HELD, "1.000 < 2.000"),
        ((2, 1), 0, NOT_HELD, "2.000 > 1.000"),
        ((1.04, 1), 0, NOT_HELD, "1.040 > 1.000"),
        ((1.04, 1), 0.05, HELD, "1.040 > 1.000"),
    ],
)
def test_check_order_holds_if_means_are_ordered(values, slack, verdict, text):
    claim = Claim("x", "x", "l2_road_m", ("flexroad", "wo_ecsrc"), slack=slack)
    means = bootstrap(figures({"flexroad": [values[0]] * 4, "wo_ecsrc": [values[1]] * 4}))
    result = check(claim, means)
    assert (result.verdict, result.paper, result.ours) == (verdict, "0.483 < 1.021", text)
    assert result.certainty == ("100% of resamples" if verdict == HELD else "0% of resamples")


def test_check_order_of_most_but_not_enough_resamples_is_not_decided():
    claim = Claim("x", "x", "l2_road_m", ("flexroad", "wo_ecsrc"))
    result = check(claim, bootstrap(figures({"flexroad": [1.0] * 4, "wo_ecsrc": [0.9, 0.9, 0.9, 5.7]})))
    assert result.verdict == NOT_DECIDED
    assert 30 < int(result.certainty.split("%")[0]) < 95


def test_check_other_dataset_or_missing_variant_is_not_tested():
    means = bootstrap(figures({"flexroad": [1.0]}))
    assert check(RISE, means).verdict == NOT_TESTED
    both = bootstrap(figures({"flexroad": [1.0], "wo_ecsrc": [2.0]}))
    assert check(RISE._replace(dataset="GeRoD"), both, "DSC3D").verdict == NOT_TESTED


def test_compare_published_figures_hold_every_claim():
    comparison = compare(as_published())
    verdicts = comparison.claims.verdict.value_counts()
    assert verdicts.to_dict() == {HELD: len(comparison.claims) - 4, NOT_TESTED: 4}
    # Except triangles, which Table I rounds.
    exact = comparison.numbers[comparison.numbers.figure != "triangles"]
    assert exact.difference.abs().max() < 1e-12
    assert len(comparison.numbers) == (3 + 19) * len(FIGURES)


def test_compare_flexroad_alone_raises():
    data = as_published()
    with pytest.raises(ConfigError, match="no variants to compare FlexRoad with"):
        compare(MetricsData(data.rows[data.rows.variant == "flexroad"]))


def test_compare_main_variants_alone_has_no_table_ii():
    rows = as_published().rows
    titles = [title for title, _, _ in compare(MetricsData(rows[rows.variant.isin(VARIANTS[:3])])).sections]
    assert "Table I: L2" in titles
    assert not any("Table II" in title for title in titles)


def test_compare_table_of_changes_matches_the_papers_text():
    table = next(table for title, table, _ in compare(as_published()).sections if "changes" in title)
    without = table[table.variant == "w/o ECSRC"].iloc[0]
    assert (without["L2 road, paper"], without["MAD road, ours"]) == ("+111%", "+135%")
    assert len(table) == len(TABLE_II) - 1


def test_compare_adds_one_table_per_stratum():
    data = as_published(3)
    rural = (data.rows.stratum == "rural") & (data.rows.variant == "rgt")
    data.rows.loc[rural, "l2_road_m"] = 9.0
    tables = {title: table for title, table, _ in compare(data).sections}
    assert tables["Our figures, rural: 1 tile"]["L2 road (m)"][1] == "9.000"
    assert tables["Our figures, urban: 2 tiles"]["L2 road (m)"][1] == "0.415"


def test_pages_name_the_data_in_first_line():
    line = "Data: made, 3 tiles (2 urban, 1 rural)."
    for name, text in pages(as_published()).items():
        assert line in text.splitlines()[0], name
    assert "The paper's figures are for GeRoD, ours are for other data" in pages(as_published())["tables.md"]
    real = as_published()
    real = MetricsData(real.rows.assign(dataset="GeRoD"))
    assert "ours are for other data" not in pages(real)["tables.md"]


def test_compare_leaves_out_and_counts_failed_tiles():
    data = as_published(3)
    failed = (data.rows.tile_id == "t1") & (data.rows.variant == "rgt")
    data.rows.loc[failed, list(FIGURES)] = np.nan
    data.rows.loc[data.rows.tile_id == "t1", "l2_road_m"] += 100
    assert data.line == "Data: made, 2 tiles (2 urban); 1 failed tile left out."
    assert compare(data).numbers.ours.max() < 200_000
    assert abs(compare(data).numbers.query("figure == 'l2_road_m'").difference).max() < 1e-12


def test_csv_page_parses_to_same_values(tmp_path):
    page = pages(as_published())["tables.csv"]
    table = pd.read_csv(io.StringIO(page), comment="#")
    row = table[(table.variant == "wo_dtm") & (table.figure == "l2_terrain_m")].iloc[0]
    assert (row.paper, row.table) == (2.941, "Table II")
    assert row.ours == pytest.approx(2.941)


def columns(row: str) -> int:
    """Return the number of columns that a line of a tabular fills."""
    spans = [re.search(r"\\multicolumn{(\d+)}", cell) for cell in re.split(r"(?<!\\)&", row)]
    return sum(int(span[1]) if span else 1 for span in spans)


def test_latex_page_is_well_formed():
    text = pages(as_published())["tables.tex"]
    assert text.isascii()
    assert text.count("\\begin{") == text.count("\\end{")
    for table in re.findall(r"\\begin{tabular}.*?\\end{tabular}", text, flags=re.DOTALL):
        kinds = re.sub(r"p{.*?}", "p", re.match(r"\\begin{tabular}{((?:[lr]|p{.*?})+)}", table)[1])
        rows = [line for line in table.splitlines() if line.endswith("\\\\")]
        assert {columns(row) for row in rows} == {len(kinds)}
        assert {"\\toprule", "\\midrule", "\\bottomrule"} <= set(table.splitlines())
        assert not re.search(r"(?<!\\)%", table)


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="pdflatex is not installed")
def test_latex_page_compiles(tmp_path):
    (tmp_path / "tables.tex").write_text(pages(as_published())["tables.tex"])
    head = "\\documentclass{article}\\usepackage{booktabs}\\begin{document}\\input{tables}\\end{document}"
    (tmp_path / "page.tex").write_text(head)
    done = subprocess.run(
        ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "page.tex"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        errors="replace",
        check=False,
    )
    assert done.returncode == 0, done.stdout[-2000:]


def made_run(path, config="ablation", dataset=("made",), factor=1.0, layers=LAYERS) -> Run:
    """Return a run over four tiles whose rows are the paper's figures."""
    tiles = tuple(
        Tile(
            f"{east}_5629250",
            Grid("EPSG:25832", east, 5629500.0, 1.0, 250, 250),
            tuple(Layer(name, (f"{name}.tif",)) for name in layers),
            str(path),
            datetime(2025, 1, 1, tzinfo=UTC),
            dataset=dataset[i % len(dataset)],
        )
        for i, east in enumerate(range(295500, 296500, 250))
    )
    run = Run.create(path, load_config(config), Catalog(tiles))
    rows = [
        {"tile_id": tile.id, "variant": name, "stratum": tile.stratum, "status": "done"}
        | {figure: published(name).value(figure) * (factor if "l2" in figure else 1) for figure in FIGURES}
        for tile in tiles
        for name in VARIANTS
    ]
    buffer = io.BytesIO()
    metrics_frame(rows).to_parquet(buffer, index=False)
    write(run.path / "metrics.parquet", buffer.getvalue())
    return run


def test_write_comparison_with_true_run_shows_both(ours, tmp_path):
    true = made_run(tmp_path / "true", "ablation_true", factor=2)
    written = write_comparison(ours, true, tmp_path / "out")
    assert {path.name for path in written} == {*pages(collect(ours, true))}
    page = (tmp_path / "out" / "tables.md").read_text()
    assert page.startswith("Data: made, 4 tiles")
    assert "| Full Pipeline | 0.483 | 0.966 |" in page
    stored = read_metrics_data(tmp_path / "out")
    assert stored.classes == ("segmented", "reference")
    for path in written:
        assert path.read_text() == pages(stored)[path.name]


def test_compare_names_the_mask_that_classed_the_cells(tmp_path):
    every = made_run(tmp_path / "every", "ablation_true")
    none = made_run(tmp_path / "none", "ablation_true", layers=("dsm", "dtm", "road_mask"))
    tiles = (*every.catalog.tiles[:2], *none.catalog.tiles[2:])
    some = replace(every, catalog=Catalog(tiles))
    for run, words in (
        (every, "classed as road or terrain by the true mask."),
        (none, "classed as road or terrain by the segmented mask."),
        (some, "by the true mask where a tile has one, else by the segmented mask."),
    ):
        assert any(note.endswith(words) for note in compare(collect(run)).notes), words


def test_write_comparison_with_dsm_run_has_road_l2_side_by_side(ours, tmp_path):
    by_dsm = made_run(tmp_path / "dsm", "ablation_dsm", factor=2)
    write_comparison(ours, None, tmp_path / "out", dsm=by_dsm)
    page = (tmp_path / "out" / "tables.md").read_text()
    section = page.partition("## L2 on roads by the reference and by the DSM\n")[2].partition("\n## ")[0]
    assert "| Full Pipeline | 0.483 | 0.483 [0.483, 0.483] | 0.966 [0.966, 0.966] |" in section
    stored = read_metrics_data(tmp_path / "out")
    assert pages(stored)["tables.md"] == page
    table = compare(stored).numbers
    rows = table[table.table == "L2 on roads by the DSM"]
    assert {*rows.figure} == {"l2_road_m"}
    assert {*rows.data} == {"made; against the DSM"}
    assert len(rows) == len(VARIANTS)


STAND_IN = "synthetic photogrammetry, stand-in for DSC3D; "
CIRCULAR, TRUTH = STAND_IN + "circular", STAND_IN + "true"


def stand_in(dataset: str, factor: float = 1.0) -> MetricsData:
    """Return scenes with the paper's figures for DSC3D, FlexRoad's road L2 multiplied by a factor."""
    data = of_tiles(3, {row.variant: row for row in TABLE_I_DSC3D}, dataset)
    data.rows.loc[data.rows.variant == "flexroad", "l2_road_m"] *= factor
    return data


def test_compare_with_stand_in_adds_dsc3d_tables_and_claims():
    data = replace(as_published(), dsc3d=(stand_in(CIRCULAR), stand_in(TRUTH, factor=3.0)))
    comparison = compare(data)
    sections = {title: (table, line) for title, table, line in comparison.sections}
    table = sections["Table I, DSC3D rows (synthetic stand-in): L2"][0].set_index("variant")
    assert table.at["FlexRoad", "L2 road (m), ours (circular)"].startswith("0.106 [")
    assert table.at["FlexRoad", "L2 road (m), ours (true)"].startswith("0.318 [")
    claims, line = sections["The paper's claims about DSC3D (synthetic stand-in)"]
    assert list(claims.verdict) == [HELD] * 4
    assert list(claims["verdict, true"]) == [NOT_HELD, HELD, HELD, HELD]
    assert CIRCULAR in line
    assert TRUTH in line
    # The main claims are about GeRoD, and all of them are tested.
    assert "36 claims about GeRoD: 36 held" in " ".join(comparison.notes)
    assert not (comparison.claims.verdict == NOT_TESTED).any()
    assert comparison.claims.groupby("data").size().to_dict() == {"made": 36, CIRCULAR: 4, TRUTH: 4}
    assert comparison.numbers.groupby("data").size()[TRUTH] == 3 * len(FIGURES)


def test_pages_with_stand_in_name_its_data():
    data = replace(as_published(), dsc3d=(stand_in(CIRCULAR), stand_in(TRUTH)))
    texts = pages(data)
    for name, text in texts.items():
        assert CIRCULAR in text, name
        assert TRUTH in text, name
        assert data.line in text.splitlines()[0], name
    # Each caption names the data of its table.
    captions = re.findall(r"\\caption{(.*)}", texts["tables.tex"])
    assert [CIRCULAR in caption for caption in captions] == ["DSC3D" in caption for caption in captions]


def test_pages_from_stored_figures_are_the_same(tmp_path):
    def rounded(data):
        return MetricsData(data.rows.astype(dict.fromkeys(FIGURES, FIGURE_DTYPE)))

    main = as_published(5)
    main.rows[list(FIGURES)] *= np.random.default_rng(0).random((5 * 21, 1))
    main, scenes = rounded(main), tuple(rounded(stand_in(name)) for name in (CIRCULAR, TRUTH))
    for data in (replace(main, dsc3d=scenes, literal=rounded(as_published(2)), dsm=main), main):
        write_metrics_data(data, tmp_path)
        assert pages(read_metrics_data(tmp_path)) == pages(data)


def test_compare_with_dsc3d_itself_has_no_stand_in():
    comparison = compare(replace(as_published(), dsc3d=(stand_in("DSC3D"),)))
    titles = [title for title, _, _ in comparison.sections]
    assert "Table I, DSC3D rows: L2" in titles
    assert not any("stand-in" in text for text in (*titles, *comparison.notes))


@pytest.fixture(scope="module")
def ours(tmp_path_factory) -> Run:
    return made_run(tmp_path_factory.mktemp("ours") / "run")


WITHOUT_TRUTH = ("dsm", "dtm", "road_mask")
OTHER_DATA = {"dataset": ("GeRoD",)}


@pytest.mark.parametrize(
    ("role", "config", "changes", "message"),
    [
        ("true", "ablation_true", OTHER_DATA, "has other data, tiles or variants than"),
        ("true", "ablation", {}, "both class by the segmented mask"),
        ("true", "ablation_true", {"layers": WITHOUT_TRUTH}, "no true road mask in its catalog; leave out"),
        ("dsm", "ablation", {}, "not measured against the DSM; --dsm needs --config ablation_dsm"),
        ("dsm", "ablation_dsm", OTHER_DATA, "has other data, tiles or variants than"),
        ("literal", "literal", OTHER_DATA, "has other data or tiles than the main run"),
        ("dsc3d_true", "dsc3d", {}, "needs --dsc3d"),
        ("run", "ablation", {"dataset": ("GeRoD", "")}, "mixes datasets: unnamed, GeRoD; run each of them"),
    ],
)
def test_collect_of_runs_that_do_not_belong_together_raises(ours, tmp_path, role, config, changes, message):
    other = made_run(tmp_path / "other", config, **changes)
    with pytest.raises(ConfigError, match=message):
        collect(**{"run": ours} | {role: other})


def test_collect_dsc3d_runs_must_match(ours, tmp_path):
    circular = made_run(tmp_path / "circular", "dsc3d", dataset=(CIRCULAR,))
    true = made_run(tmp_path / "true", "dsc3d", dataset=(TRUTH,), factor=2)
    data = collect(ours, None, circular, true)
    assert [scenes.dataset for scenes in data.dsc3d] == [CIRCULAR, TRUTH]
    with pytest.raises(ConfigError, match="has the same data as"):
        collect(ours, None, circular, circular)


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
