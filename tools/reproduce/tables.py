"""The paper's Tables I and II with our figures beside them, written as Markdown, LaTeX, CSV and HTML.

The metrics that they are computed from are written, too.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from markupsafe import escape

from flexroad.catalog.storage.paths import write
from flexroad.catalog.text import count
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.store.tables import csv_text
from flexroad.tools.report.content import FIGURES
from flexroad.tools.report.pages import Section, are_numbers, markdown_sections, marked, template
from flexroad.tools.reproduce.claims import (
    HELD,
    LEVEL,
    NOT_DECIDED,
    NOT_HELD,
    NOT_TESTED,
    RESAMPLES,
    STRONGER,
    WEAKER,
    Means,
    Verdict,
    bootstrap,
    check,
    percent,
)
from flexroad.tools.reproduce.metrics_data import PARTLY, MetricsData, collect, write_metrics_data
from flexroad.tools.reproduce.published import (
    BASE,
    CLAIMS,
    DSC3D,
    GEROD,
    TABLE_I,
    TABLE_I_DSC3D,
    TABLE_II,
    Row,
)
from flexroad.tools.reproduce.sections import (
    format_figure,
    label_without_unit,
    literal_column,
    literal_notes,
    literal_numbers,
    literal_sections,
    numbers,
    road_numbers,
    road_sections,
    score_sections,
    side_by_side,
    verdicts_table,
)

TITLE = "The paper's tables, and ours"
LATEX = {
    "θz": r"$\theta_z$",
    "L2": r"$\mathcal{L}_2$",
    "°": r"\textdegree{}",
    "×": r"$\times$",
    "–": "--",
    "<": "$<$",
    ">": "$>$",
}
"""LaTeX for characters that pdflatex does not print, or prints differently from the paper."""
NARROW, SENTENCE = 12, 25
"""A text column is wrapped if its longest cell has more characters than one of these; see `_latex`."""
MASKS = {
    "segmented": "segmented mask",
    "reference": "true mask",
    PARTLY: "true mask where a tile has one, else by the segmented mask",
}
DSC3D_ROWS = "Table I, DSC3D rows"
DSC3D_CLAIMS = tuple(claim for claim in CLAIMS if claim.dataset == DSC3D)
REFERENCES = ("circular", "true")
"""Names of the two references: made with ECSRC as in the paper (circular), and the true surface."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """Our figures beside the paper's."""

    line: str
    """The data of our figures, in one line."""
    notes: tuple[str, ...]
    """How to read the tables."""
    sections: tuple[Section, ...]
    numbers: pd.DataFrame
    """Every number of the tables, one per row, not rounded."""
    claims: pd.DataFrame
    """Every claim with its verdict; claims about DSC3D once per reference."""


def write_comparison(
    run: Run,
    true: Run | None,
    folder: Path,
    dsc3d: Run | None = None,
    dsc3d_true: Run | None = None,
    literal: Run | None = None,
    dsm: Run | None = None,
) -> tuple[Path, ...]:
    """Write the paper's tables with a run's figures beside them; return the paths of the files.

    - `run`: a run with variants named as in configs/ablation.yaml; missing variants are left out.
    - `true`, `dsc3d`, `dsc3d_true`, `literal`, `dsm`: the runs that `collect` takes.
    """
    data = collect(run, true, dsc3d, dsc3d_true, literal, dsm)
    texts = pages(data)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_metrics_data(data, folder)
        for name, text in texts.items():
            write(folder / name, text.encode())
    except OSError as error:
        raise ConfigError(f"cannot write the tables to {folder}: {error}; choose another -o") from error
    return tuple(folder / name for name in texts)


def pages(data: MetricsData) -> dict[str, str]:
    """Return the pages by file name; equal data gives equal pages."""
    comparison = compare(data)
    return {
        "tables.md": markdown_page(comparison),
        "tables.tex": latex_page(comparison),
        "tables.csv": csv_page(comparison.numbers, comparison.line),
        "claims.csv": csv_page(comparison.claims, comparison.line),
        "tables.html": html_page(comparison),
    }


def compare(data: MetricsData) -> Comparison:
    """Compare the figures of a run with the paper's."""
    paper = DSC3D if data.dataset == DSC3D else GEROD
    tables = {"Table I": TABLE_I_DSC3D} if paper == DSC3D else {"Table I": TABLE_I, "Table II": TABLE_II}
    means = {classes: bootstrap(data.part(classes)) for classes in data.classes}
    head = means[data.classes[0]]
    ours = {"ours": head} | literal_column(data)
    tables = {
        name: tuple(row for row in rows if row.variant in head.variants) for name, rows in tables.items()
    }
    # Table II with the full pipeline only would repeat Table I.
    tables = {name: rows for name, rows in tables.items() if {row.variant for row in rows} - {BASE}}
    if not tables:
        raise ConfigError("the run has no variants to compare FlexRoad with; use --config ablation")
    dsc3d_sections, dsc3d_notes, dsc3d_numbers, dsc3d_claims = _dsc3d(data.dsc3d)
    # Claims about DSC3D have their own table if there is a run to test them on.
    tested = [claim for claim in CLAIMS if claim.dataset == paper or not data.dsc3d]
    verdicts = {
        classes: [check(claim, class_means, paper) for claim in tested]
        for classes, class_means in means.items()
    }
    claims = verdicts_table({MASKS[classes]: results for classes, results in verdicts.items()})
    sections = [
        *(section for name, rows in tables.items() for section in side_by_side(name, rows, ours)),
        *(_relative(tables["Table II"], head) if BASE in head.variants and "Table II" in tables else []),
        *(literal_sections(tables.get("Table II", ()), data)),
        *road_sections(_union(tables), head, data),
        ("The paper's claims", claims, ""),
        *dsc3d_sections,
        *_other_masks(_union(tables), means),
        *_per_stratum(_union(tables), data),
    ]
    table_numbers = [
        numbers(name, rows, classes, class_means, data.dataset)
        for classes, class_means in means.items()
        for name, rows in tables.items()
    ]
    table_numbers += [*literal_numbers(tables, data), *road_numbers(_union(tables), data)]
    return Comparison(
        data.line,
        (*_notes(data, paper, verdicts[data.classes[0]]), *literal_notes(data), *dsc3d_notes),
        tuple(sections),
        pd.concat([*table_numbers, *dsc3d_numbers], ignore_index=True),
        pd.concat([claims.assign(data=data.dataset), *dsc3d_claims], ignore_index=True),
    )


def _notes(data: MetricsData, paper: str, verdicts: list[Verdict]) -> Iterator[str]:
    classes = data.classes[0]
    if data.dataset != paper:
        yield (
            f"The paper's figures are for {paper}, ours are for other data. Orders and ratios can be "
            "compared; metres and degrees only if the data are similar."
        )
    yield (
        f"Means over tiles, with {LEVEL}% intervals from {RESAMPLES} resamples of the tiles in brackets. "
        f"Cells are classed as road or terrain by the {MASKS[classes]}."
    )
    yield (
        "Adam's steps have a fixed length, so that rounding grows from step to step: between processors the "
        "rows with NURBS differ by up to 5 mm on single tiles, and their means by one unit of the last digit."
    )
    kinds = (HELD, WEAKER, STRONGER, NOT_HELD, NOT_DECIDED, NOT_TESTED)
    totals = {kind: sum(v.verdict == kind for v in verdicts) for kind in kinds}
    counts = [f"{total} {kind}" for kind, total in totals.items() if total or kind != NOT_TESTED]
    about = f" about {paper}" if len(verdicts) < len(CLAIMS) else ""
    yield (
        f"The paper's {len(verdicts)} claims{about}: {', '.join(counts)}. An order holds if the means are in "
        "that order. A change holds if it has the paper's sign and the logarithm of its ratio is between "
        "half and twice the paper's value; below that range it is weaker, above it stronger. A "
        f"claim is not decided if fewer than {LEVEL}% of the resamples give the verdict of the means"
        f"{', and not tested if the run has no such data or variants' if totals[NOT_TESTED] else ''}."
    )


def _union(tables: dict[str, tuple[Row, ...]]) -> tuple[Row, ...]:
    """Return the rows of all tables, each variant once, with the label of the last table."""
    return tuple({row.variant: row for rows in tables.values() for row in rows}.values())


def _relative(rows: tuple[Row, ...], means: Means) -> Iterator[Section]:
    base = next(row for row in rows if row.variant == BASE)
    others = [row for row in rows if row is not base]
    table = pd.DataFrame({"variant": [row.label for row in others]})
    for figure in FIGURES:
        table[f"{label_without_unit(figure)}, paper"] = [
            percent(row.value(figure) / base.value(figure)) for row in others
        ]
        table[f"{label_without_unit(figure)}, ours"] = [
            percent(means.ratio(row.variant, BASE, figure)[0]) for row in others
        ]
    yield "Table II: changes from the full pipeline", table, ""
    yield from score_sections(rows, means)


def _other_masks(rows: tuple[Row, ...], means: dict[str, Means]) -> Iterator[Section]:
    if len(means) < 2:
        return
    table = pd.DataFrame({"variant": [row.label for row in rows]})
    for figure in FIGURES:
        if figure == "triangles":
            continue
        for classes, class_means in means.items():
            values = [format_figure(class_means.mean[row.variant, figure], figure) for row in rows]
            table[f"{FIGURES[figure]}, {MASKS[classes]}"] = values
    yield "Our figures by the segmented mask, and by the true mask and true heights", table, ""


def _per_stratum(rows: tuple[Row, ...], data: MetricsData) -> Iterator[Section]:
    part = data.part(data.classes[0])
    strata = data.tiles.stratum
    for stratum in sorted(set(strata) - {""}):
        selected = part[part.index.get_level_values("tile_id").isin(strata.index[strata == stratum])]
        if selected.empty:
            continue
        means = selected.groupby("variant").mean().to_dict("index")
        table = pd.DataFrame({"variant": [row.label for row in rows]})
        for figure, label in FIGURES.items():
            table[label] = [format_figure(means[row.variant][figure], figure) for row in rows]
        tiles = len(selected.index.unique("tile_id"))
        yield f"Our figures, {stratum}: {count(tiles, 'tile')}", table, ""


def _dsc3d(
    runs: tuple[MetricsData, ...],
) -> tuple[list[Section], tuple[str, ...], list[pd.DataFrame], list[pd.DataFrame]]:
    """Return sections, notes, numbers and verdicts of the runs for DSC3D, with one table per reference."""
    if not runs:
        return [], (), [], []
    title = f"{DSC3D_ROWS}{_standing_in(runs[0])}"
    names = REFERENCES if len(runs) == len(REFERENCES) else ("",)
    means = {name: bootstrap(run.part(run.classes[0])) for name, run in zip(names, runs, strict=True)}
    shared = frozenset.intersection(*(run_means.variants for run_means in means.values()))
    rows = tuple(row for row in TABLE_I_DSC3D if row.variant in shared)
    verdicts = {
        name: [check(claim, run_means, DSC3D) for claim in DSC3D_CLAIMS] for name, run_means in means.items()
    }
    named = zip(names, runs, strict=True)
    line = " ".join(f"{name.capitalize()}: {run.line}" if name else run.line for name, run in named)
    ours = {f"ours ({name})" if name else "ours": run_means for name, run_means in means.items()}
    sections = [
        *side_by_side(title, rows, ours, line),
        (f"The paper's claims about DSC3D{_standing_in(runs[0])}", verdicts_table(verdicts), line),
    ]
    return (
        sections,
        _dsc3d_notes(runs),
        [
            numbers(title, rows, run.classes[0], run_means, run.dataset)
            for run, run_means in zip(runs, means.values(), strict=True)
        ],
        [
            verdicts_table({name: results}).assign(data=run.dataset)
            for run, (name, results) in zip(runs, verdicts.items(), strict=True)
        ],
    )


def _standing_in(run: MetricsData) -> str:
    """Return the addition to a title if the data is not DSC3D."""
    if run.dataset == DSC3D:
        return ""
    return " (synthetic stand-in)" if run.dataset.startswith("synthetic") else " (stand-in)"


def _dsc3d_notes(runs: tuple[MetricsData, ...]) -> tuple[str, ...]:
    if runs[0].dataset == DSC3D:
        return ()
    truth = " Figures marked (true) are measured against the true surface." if len(runs) > 1 else ""
    return (
        f"The DSC3D rows are compared with another data set: {runs[0].dataset}. As in the paper, the "
        f"reference was made with ECSRC, which favours a method that starts with ECSRC.{truth} The paper "
        "gives no reason for RGT's 15.411 m on terrain; a mask of all ground between roofs and crowns leaves "
        "as much.",
    )


def markdown_page(comparison: Comparison) -> str:
    """Return the comparison as Markdown; the first line names the data."""
    parts = [marked(comparison.line), f"# {TITLE}", *comparison.notes]
    parts += markdown_sections(comparison.sections)
    return "\n\n".join(parts) + "\n"


def csv_page(table: pd.DataFrame, line: str) -> str:
    """Return a table as CSV below a comment that names the data."""
    return f"# {line}\n{csv_text(table)}"


def html_page(comparison: Comparison) -> str:
    """Return the comparison as one self-contained HTML page."""
    page = template("tables.html.j2", Path(__file__).parent).render(
        title=TITLE, line=comparison.line, notes=comparison.notes, sections=comparison.sections
    )
    return f"<!-- {escape(comparison.line)} -->\n{page}\n"


def latex_page(comparison: Comparison) -> str:
    r"""Return tables for ``\input`` in a document that uses the package booktabs."""
    parts = [f"% {comparison.line}", *(f"% {note}" for note in comparison.notes)]
    for title, table, line in comparison.sections:
        parts.append(_latex(table, f"{title}. {line or comparison.line}"))
    return "\n".join(parts) + "\n"


def _latex(table: pd.DataFrame, caption: str) -> str:
    lengths = [max(map(len, column), default=0) for _, column in table.items()]
    # A column of sentences makes the page too wide. Then every text column over NARROW is wrapped.
    widest = NARROW if max(lengths) > SENTENCE else SENTENCE
    kinds = "".join(
        "r" if number else "l" if length <= widest else "p{0.12\\linewidth}"
        for number, length in zip(are_numbers(table), lengths, strict=True)
    )
    first, *others = [str(column).split(", ") for column in table.columns]
    if all(len(parts) == 2 for parts in others):
        # "L2 road (m), paper" and "L2 road (m), ours" get one common heading "L2 road (m)".
        pairs = [("", *first), *((parts[0], parts[1]) for parts in others)]
        table = table.set_axis(pd.MultiIndex.from_tuples(pairs), axis="columns")
    body = table.to_latex(index=False, escape=True, column_format=kinds, multicolumn_format="c")
    caption = caption.replace("_", r"\_").replace("%", r"\%")
    for plain, printed in LATEX.items():
        body, caption = body.replace(plain, printed), caption.replace(plain, printed)
    return (
        "\\begin{table*}\n\\centering\\scriptsize\\setlength{\\tabcolsep}{3pt}\n"
        f"\\caption{{{caption}}}\n{body}\\end{{table*}}"
    )
