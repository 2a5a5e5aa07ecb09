"""The DSC3D rows of Table I and the claims about them, compared with runs over DSC3D or a stand-in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import pandas as pd

from flexroad.pipeline.reproduce.bootstrap import bootstrap
from flexroad.pipeline.reproduce.claims import CLAIMS, check
from flexroad.pipeline.reproduce.metrics_data import MetricsData
from flexroad.pipeline.reproduce.published import DSC3D, TABLE_I_DSC3D
from flexroad.pipeline.reproduce.sections import Section, numbers, side_by_side, verdicts_table

NAME = "Table I, DSC3D rows"
DSC3D_CLAIMS = tuple(claim for claim in CLAIMS if claim.dataset == DSC3D)
REFERENCES = ("circular", "true")
"""Names of the two references: made with ECSRC as in the paper (circular), and the true surface."""


@dataclass(frozen=True, eq=False)
class Dsc3dComparison:
    """The parts of the comparison that are about DSC3D; all empty without a run for it."""

    sections: tuple[Section, ...]
    notes: tuple[str, ...]
    numbers: tuple[pd.DataFrame, ...]
    claims: tuple[pd.DataFrame, ...]
    """One table of verdicts per reference."""


def compare_dsc3d(runs: tuple[MetricsData, ...]) -> Dsc3dComparison:
    """Compare the runs for DSC3D, one per reference, with the paper's rows."""
    if not runs:
        return Dsc3dComparison((), (), (), ())
    title = f"{NAME}{_standing_in(runs[0])}"
    names = REFERENCES if len(runs) == len(REFERENCES) else ("",)
    means = {name: bootstrap(run.part(run.classes[0])) for name, run in zip(names, runs, strict=True)}
    shared = frozenset.intersection(*(run_means.variants for run_means in means.values()))
    rows = tuple(row for row in TABLE_I_DSC3D if row.variant in shared)
    verdicts = {
        name: [check(claim, run_means, DSC3D) for claim in DSC3D_CLAIMS] for name, run_means in means.items()
    }
    line = _line(dict(zip(names, runs, strict=True)))
    return Dsc3dComparison(
        sections=(
            *side_by_side(title, rows, {_ours(name): run_means for name, run_means in means.items()}, line),
            Section(f"The paper's claims about DSC3D{_standing_in(runs[0])}", verdicts_table(verdicts), line),
        ),
        notes=_notes(runs),
        numbers=tuple(
            numbers(title, rows, run.classes[0], run_means, run.dataset)
            for run, run_means in zip(runs, means.values(), strict=True)
        ),
        claims=tuple(
            verdicts_table({name: results}).assign(data=run.dataset)
            for run, (name, results) in zip(runs, verdicts.items(), strict=True)
        ),
    )


def _standing_in(run: MetricsData) -> str:
    """Return the addition to a title if the data is not DSC3D."""
    if run.dataset == DSC3D:
        return ""
    return " (synthetic stand-in)" if run.dataset.startswith("synthetic") else " (stand-in)"


def _ours(name: str) -> str:
    return f"ours ({name})" if name else "ours"


def _line(runs: Mapping[str, MetricsData]) -> str:
    return " ".join(f"{name.capitalize()}: {run.line}" if name else run.line for name, run in runs.items())


def _notes(runs: tuple[MetricsData, ...]) -> tuple[str, ...]:
    if runs[0].dataset == DSC3D:
        return ()
    truth = " Figures marked (true) are measured against the true surface." if len(runs) > 1 else ""
    return (
        f"The DSC3D rows are compared with another data set: {runs[0].dataset}. As in the paper, the "
        f"reference was made with ECSRC, which favours a method that starts with ECSRC.{truth} The paper "
        "gives no reason for RGT's 15.411 m on terrain; a mask of all ground between roofs and crowns leaves "
        "as much.",
    )
