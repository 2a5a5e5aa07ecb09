"""Write the comparison with the paper: Markdown, LaTeX, CSV and HTML, and the figures they rest on."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from flexroad.catalog.storage.paths import write
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.report.pages import are_numbers, markdown, template
from flexroad.pipeline.reproduce.comparison import Comparison, compare
from flexroad.pipeline.reproduce.metrics_data import MetricsData, collect, write_metrics_data
from flexroad.pipeline.run.record import Run

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
"""What pdflatex does not print, or not as the paper does."""
NARROW, SENTENCE = 12, 25
"""Characters of a column of text: fewer never need a second line, more always do."""


def write_comparison(
    run: Run, true: Run | None, folder: Path, dsc3d: Run | None = None, dsc3d_true: Run | None = None
) -> tuple[Path, ...]:
    """Write the tables of a run beside the paper's; return the files.

    Parameters
    ----------
    run : Run
        With variants named as in configs/ablation.yaml; those it lacks are left out.
    true : Run, optional
        The same with ``evaluate.classes: reference``.
    folder : Path
        Where to.
    dsc3d : Run, optional
        For the rows of DSC3D: its scenes, or what stands in for them.
    dsc3d_true : Run, optional
        The same scenes against the truth.

    Raises
    ------
    ConfigError
        If a run has no figures, mixes data or is about other tiles than the other, or the folder cannot be
        written.
    """
    data = collect(run, true, dsc3d, dsc3d_true)
    made = pages(data)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_metrics_data(data, folder)
        for name, text in made.items():
            write(folder / name, text.encode())
    except OSError as error:
        raise ConfigError(f"cannot write the tables to {folder}: {error}; choose another -o") from error
    return tuple(folder / name for name in made)


def pages(data: MetricsData) -> dict[str, str]:
    """Return the pages by file name; equal figures give equal pages."""
    found = compare(data)
    return {
        "tables.md": markdown_page(found),
        "tables.tex": latex_page(found),
        "tables.csv": csv_page(found.numbers, found.line),
        "claims.csv": csv_page(found.claims, found.line),
        "tables.html": html_page(found),
    }


def markdown_page(found: Comparison) -> str:
    """Return the comparison as Markdown; the data comes first."""
    parts = [found.line, f"# {TITLE}", *found.notes]
    for section in found.sections:
        parts += [f"## {section.title}", *([section.line] if section.line else []), markdown(section.table)]
    return "\n\n".join(parts) + "\n"


def csv_page(table: pd.DataFrame, line: str) -> str:
    """Return a table as CSV below a comment that names the data."""
    return f"# {line}\n{table.to_csv(index=False)}"


def html_page(found: Comparison) -> str:
    """Return one self-contained page."""
    sections = [(section.title, section.table, section.line) for section in found.sections]
    page = template("tables.html.j2", Path(__file__).parent).render(
        title=TITLE, line=found.line, notes=found.notes, sections=sections
    )
    return f"<!-- {found.line} -->\n{page}\n"


def latex_page(found: Comparison) -> str:
    r"""Return tables to ``\input`` into a document with the package booktabs."""
    parts = [f"% {found.line}", *(f"% {note}" for note in found.notes)]
    for section in found.sections:
        parts.append(_latex(section.table, f"{section.title}. {section.line or found.line}"))
    return "\n".join(parts) + "\n"


def _latex(table: pd.DataFrame, caption: str) -> str:
    lengths = [max(map(len, column), default=0) for _, column in table.items()]
    # Sentences make a page too wide, unless all the columns of text give way.
    widest = NARROW if max(lengths) > SENTENCE else SENTENCE
    kinds = "".join(
        "r" if number else "l" if length <= widest else "p{0.12\\linewidth}"
        for number, length in zip(are_numbers(table), lengths, strict=True)
    )
    body = _grouped(table).to_latex(index=False, escape=True, column_format=kinds, multicolumn_format="c")
    caption = caption.replace("_", r"\_").replace("%", r"\%")
    for plain, printed in LATEX.items():
        body, caption = body.replace(plain, printed), caption.replace(plain, printed)
    return (
        "\\begin{table*}\n\\centering\\scriptsize\\setlength{\\tabcolsep}{3pt}\n"
        f"\\caption{{{caption}}}\n{body}\\end{{table*}}"
    )


def _grouped(table: pd.DataFrame) -> pd.DataFrame:
    """Write "L2 road (m), paper" and "L2 road (m), ours" as two columns below one head."""
    first, *others = [str(column).split(", ") for column in table.columns]
    if any(len(parts) != 2 for parts in others):
        return table
    pairs = [("", *first), *((parts[0], parts[1]) for parts in others)]
    return table.set_axis(pd.MultiIndex.from_tuples(pairs), axis="columns")
