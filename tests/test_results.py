"""The published results stay true: pages are made from the figures beside them, and prose quotes them."""

import re
from pathlib import Path

import pandas as pd

from flexroad.tools.reproduce.metrics_data import FILE
from flexroad.tools.reproduce.published import published
from flexroad.tools.reproduce.tables import pages
from tests.stored_metrics import read_metrics_data

ROOT = Path(__file__).parent.parent
RESULTS = ROOT / "docs" / "results"
LARGEST_BYTES = 300_000
NUMBER = re.compile(r"(?<![\w.])(?:\d+\.\d+|[+-]\d+%)(?![\w.])")
"""What a reader would take for a result: a decimal, or a signed change in percent."""
QUOTED = re.compile(r"<!-- results -->(.*?)<!-- /results -->", flags=re.DOTALL)


def prose() -> dict[str, str]:
    """Return the texts that quote the tables: pages beside them, and marked parts of other pages."""
    others = ("tables.md", "figures.md", "causes.md", "real_data.md", "speed.md")
    texts = {page.name: page.read_text() for page in RESULTS.glob("*.md") if page.name not in others}
    return texts | {"causes.md (quoted)": "".join(QUOTED.findall((RESULTS / "causes.md").read_text()))}


def test_published_results_are_those_of_their_figures():
    assert (RESULTS / FILE).stat().st_size < LARGEST_BYTES
    made = pages(read_metrics_data(RESULTS))
    assert [name for name, text in made.items() if (RESULTS / name).read_text() != text] == []
    known = set(NUMBER.findall(made["tables.md"]))
    for name, text in prose().items():
        assert [number for number in NUMBER.findall(text) if number not in known] == [], name


def test_causes_counts_the_verdicts():
    """The sentences of causes.md that count claims and changes agree with the tables."""
    causes, page = ((RESULTS / name).read_text() for name in ("causes.md", "tables.md"))
    claims = re.search(r"The paper's \d+ claims about GeRoD: [^.]*\.", page)[0]
    changes = re.search(r"\d+ changes of L2 and MAD [^.]*\.", page)[0]
    for sentence in (claims, changes):
        assert sentence in " ".join(causes.split())


def test_causes_says_which_claims_about_dsc3d_hold():
    page = (RESULTS / "tables.md").read_text()
    claims = [line for line in page.splitlines() if line.startswith("| DSC3D: ")]
    verdicts = [cell.strip() for line in claims for cell in line.split("|") if "held" in cell]
    assert verdicts == 2 * len(claims) * ["held"]
    causes = " ".join((RESULTS / "causes.md").read_text().split())
    assert (
        f"There all {len(claims)} claims hold, by the paper's circular reference and by the true one"
        in causes
    )


def tables(title: str) -> list[dict[str, str]]:
    """Return the rows of a published table by column; figures are without their intervals."""
    lines = (
        (RESULTS / "tables.md").read_text().partition(f"## {title}\n")[2].partition("\n## ")[0].splitlines()
    )
    cells = [
        [re.sub(r" \[.*\]", "", cell.strip()) for cell in line.strip("|").split("|")]
        for line in lines
        if line.startswith("|")
    ]
    return [dict(zip(cells[0], row, strict=True)) for row in cells[2:]]


def row(table: list[dict[str, str]], variant: str, *columns: str) -> str:
    """Return cells of a row, as causes.md writes them."""
    (found,) = (row for row in table if row["variant"] == variant)
    return " / ".join(found[column] for column in columns)


def test_causes_has_the_first_table():
    text = (RESULTS / "causes.md").read_text()
    l2, mad, triangles = (tables(f"Table I: {name}") for name in ("L2", "MAD", "T"))
    for error, angle, number in zip(l2, mad, triangles, strict=True):
        figures = [*error.items(), *angle.items(), *number.items()]
        shown = [value for name, value in figures if name.endswith((", paper", ", ours"))]
        assert f"| {error['variant']} | {' | '.join(shown)} |\n" in text


def benchmark_means(name: str) -> list[float]:
    """Return L2 road, RMSE road, MAD road, L2 terrain and T of a row of fit.md, by the true classes."""
    text = (ROOT / "docs" / "fit.md").read_text().partition("| benchmark, 240 tiles, seed 1 |")[2]
    cells = re.search(rf"\| ?{name} \| (.*) \|\n", "|" + text)[1].split(" | ")
    return [float(cell.replace(",", "")) for cell in cells]


def test_readme_has_the_errors_against_the_truth():
    """Its four rows are as in the tables and, for production, of the page on the fit."""
    readme = (ROOT / "README.md").read_text()
    true = tables("Our figures by the segmented mask, and by the true mask and true heights")
    triangles = tables("Table I: T")
    columns = [f"{figure}, true mask" for figure in ("L2 road (m)", "L2 terrain (m)", "MAD road (°)")]
    for name, variant, ours in (
        ("plane", "Plane", "Plane"),
        ("regular grid of the DSM", "RGT", "RGT"),
        ("FlexRoad, `--config paper`", "Full Pipeline", "FlexRoad"),
    ):
        figures = " | ".join(row(true, variant, *columns).split(" / "))
        assert f"| {name} | {figures} | {row(triangles, ours, 'T, ours')} |\n" in readme
    l2_road, _, mad_road, l2_terrain, t = benchmark_means("production")
    figures = f"{l2_road:.3f} | {l2_terrain:.3f} | {mad_road:.3f} | {t:,.0f}"
    assert f"| FlexRoad, `--config production` | {figures} |\n" in readme


def test_causes_has_the_published_figures_of_the_calibrated_benchmark():
    """The last column of the tables of section 7: seed 1, as published."""
    section = (RESULTS / "causes.md").read_text().partition("## 7.")[2]
    quoted = [line.split("|")[-2].strip() for line in section.splitlines() if line.startswith("| ")]
    l2, mad, triangles = (tables(f"Table II: {name}") for name in ("L2", "MAD", "T"))
    baselines, smooth = tables("Table I: L2"), tables("Table I: MAD")
    both = "L2 road (m), ours", "L2 terrain (m), ours"
    angles = "MAD road (°), ours", "MAD terrain (°), ours"
    true = tables("Our figures by the segmented mask, and by the true mask and true heights")
    by_truth = [f"{figure}, true mask" for figure in ("L2 road (m)", "L2 terrain (m)")]
    expected = [
        row(triangles, "Full Pipeline", "T, ours"),
        row(baselines, "RGT", *both),
        row(smooth, "RGT", *angles),
        row(baselines, "Plane", *both),
        f"{row(l2, 'Full Pipeline', *both)} ({row(true, 'Full Pipeline', *by_truth)})",
        f"{row(mad, 'Full Pipeline', *angles)} "
        f"({row(true, 'Full Pipeline', 'MAD road (°), true mask', 'MAD terrain (°), true mask')})",
        *(
            f"{row(l2, variant, both[0])} ({row(true, variant, by_truth[0])})"
            for variant in ("w/o ECSRC", "θz = 10.0 m", "θz = 0.1 m")
        ),
        f"{row(l2, 'w/o NURBS', *both)} ({row(true, 'w/o NURBS', *by_truth)})",
    ]
    scenes = {
        name: tables(f"Table I, DSC3D rows (synthetic stand-in): {name}") for name in ("L2", "MAD", "T")
    }
    circular = [f"{column} (circular)" for column in (*both, *angles)]
    expected += [
        row(scenes["T"], "FlexRoad", "T, ours (circular)"),
        row(scenes["L2"], "RGT", *circular[:2]),
        row(scenes["MAD"], "RGT", *circular[2:]),
        row(scenes["L2"], "Plane", *circular[:2]),
        row(scenes["L2"], "FlexRoad", *circular[:2]),
        row(scenes["MAD"], "FlexRoad", *circular[2:]),
    ]
    assert [figure for figure in expected if figure not in quoted] == []


def test_causes_has_road_l2_by_the_dsm():
    """Each row of section 8 is one of the table that has both references."""
    rows = tables("L2 on roads by the reference and by the DSM")
    columns = [f"L2 road (m), {name}" for name in ("paper", "ours by the reference", "ours by the DSM")]
    known = {f"| {row['variant']} | {' | '.join(row[column] for column in columns)} |" for row in rows}
    section = (RESULTS / "causes.md").read_text().partition("## 8.")[2]
    shown = [line for line in section.splitlines() if line.startswith("| ")][2:]
    assert len(shown) > 8
    assert [line for line in shown if line not in known] == []


def test_data_page_has_the_errors_on_real_data():
    """Tiles, L2 on roads by three methods, and L2 of FlexRoad on terrain of each data set."""
    shown = (ROOT / "docs" / "data.md").read_text().partition("## Real data")[2].partition("\n## ")[0]
    text = (RESULTS / "real_data.md").read_text()
    figures = r"\| (plane|rgt|flexroad) \| (\d+) \| (\S+) \| (\S+) \|"
    rows = re.findall(figures, text)
    sets = [rows[first : first + 3] for first in range(0, len(rows), 3)]
    expected = [" | ".join((plane[1], plane[2], grid[2], ours[2], ours[3])) for plane, grid, ours in sets]
    quoted = re.findall(r"^\| [^|]+ \| (\d.*) \|$", shown, flags=re.MULTILINE)
    assert len(expected) == 7
    assert quoted == expected


def test_fit_says_by_how_much_production_is_more_accurate():
    paper, production = (benchmark_means(name)[0] for name in ("paper", "production"))
    fall = f"lower by {1 - production / paper:.0%} ({paper:.3f} to {production:.3f} m"
    assert fall in (ROOT / "docs" / "fit.md").read_text()


def test_causes_has_the_changes_of_the_stored_fits():
    means = pd.read_csv(RESULTS / "causes.csv")
    text = (RESULTS / "causes.md").read_text()
    ours, squared = (
        means[means.fit == fit].set_index("roads") for fit in ("L1, from the DTM", "squared loss")
    )
    for part, figure in ((ours, "l2_road_m"), (squared, "l2_road_m"), (squared, "mad_road_deg")):
        rise = part[figure]["all segmented cells"] / part[figure]["ECSRC, theta_z = 0.5 m"] - 1
        assert f" by {rise:.0%}" in text


def test_causes_bound_follows_from_the_published_tables():
    """Target of the fit without ECSRC: RGT on roads, the DTM elsewhere; see section 1 of the page."""
    text = " ".join((RESULTS / "causes.md").read_text().split())
    road, terrain = published("rgt").l2_road_m, published("wo_nurbs").l2_terrain_m
    target = 0.18 * road + 0.82 * terrain
    without, full = (
        0.18 * row.l2_road_m + 0.82 * row.l2_terrain_m for row in map(published, ("wo_ecsrc", "flexroad"))
    )
    assert f"that is {target:.3f} m, and twice this is {2 * target:.2f} m" in text
    assert f"{without:.2f} m over all cells" in text
    assert f"({full:.3f} m over all cells)" in text
    assert without > 2 * target + 0.1 > full


def test_the_causes_quote_the_figures_by_quarter():
    metrics = pd.read_parquet(RESULTS / FILE)
    text = (RESULTS / "causes.md").read_text().replace("\n", " ")
    for classes in ("segmented", "reference"):
        part = metrics[metrics.classes == classes]
        road = part.pivot_table(index="tile_id", columns="variant", values="l2_road_m")
        means = road.groupby(pd.qcut(road.rgt, 4), observed=True).mean()
        *three, last = [f"{change:+.0%}" for change in means.grid_55 / means.flexroad - 1]
        assert f"{', '.join(three)} and {last}" in text, classes
