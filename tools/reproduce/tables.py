"""Write the comparison with the paper as Markdown, LaTeX, CSV and HTML, and the metrics behind it."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
from markupsafe import escape

from flexroad.catalog.storage.paths import write
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.run.record import Run
from flexroad.pipeline.store.tables import csv_text
from flexroad.tools.report.pages import are_numbers, markdown, marked, template
from flexroad.tools.reproduce.comparison import Comparison, compare
from flexroad.tools.reproduce.metrics_data import MetricsData, collect, write_metrics_data

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
"""Limits of a text column's longest cell (characters) above which it is wrapped; see `_latex`."""


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


def markdown_page(comparison: Comparison) -> str:
    """Return the comparison as Markdown; the first line names the data."""
    parts = [marked(comparison.line), f"# {TITLE}", *comparison.notes]
    for section in comparison.sections:
        line = [section.line] if section.line else []
        parts += [f"## {marked(section.title)}", *line, markdown(section.table)]
    return "\n\n".join(parts) + "\n"


def csv_page(table: pd.DataFrame, line: str) -> str:
    """Return a table as CSV below a comment that names the data."""
    return f"# {line}\n{csv_text(table)}"


def html_page(comparison: Comparison) -> str:
    """Return the comparison as one self-contained HTML page."""
    sections = [(section.title, section.table, section.line) for section in comparison.sections]
    page = template("tables.html.j2", Path(__file__).parent).render(
        title=TITLE, line=comparison.line, notes=comparison.notes, sections=sections
    )
    return f"<!-- {escape(comparison.line)} -->\n{page}\n"


def latex_page(comparison: Comparison) -> str:
    r"""Return tables for ``\input`` in a document that uses the package booktabs."""
    parts = [f"% {comparison.line}", *(f"% {note}" for note in comparison.notes)]
    for section in comparison.sections:
        parts.append(_latex(section.table, f"{section.title}. {section.line or comparison.line}"))
    return "\n".join(parts) + "\n"


def _latex(table: pd.DataFrame, caption: str) -> str:
    lengths = [max(map(len, column), default=0) for _, column in table.items()]
    # A column of sentences makes the page too wide: then every text column over NARROW is wrapped.
    widest = NARROW if max(lengths) > SENTENCE else SENTENCE
    kinds = "".join(
        "r" if number else "l" if length <= widest else "p{0.12\\linewidth}"
        for number, length in zip(are_numbers(table), lengths, strict=True)
    )
    first, *others = [str(column).split(", ") for column in table.columns]
    if all(len(parts) == 2 for parts in others):
        # "L2 road (m), paper" and "L2 road (m), ours" stand under one heading "L2 road (m)".
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
