"""The rows of DSC3D in Table I and the claims about them, beside scenes of it or what stands in for them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import pandas as pd

from flexroad.pipeline.reproduce.bootstrap import bootstrap
from flexroad.pipeline.reproduce.claims import CLAIMS, check
from flexroad.pipeline.reproduce.metrics_data import MetricsData
from flexroad.pipeline.reproduce.published import DSC3D, TABLE_I_DSC3D
from flexroad.pipeline.reproduce.sections import Section, beside, numbers, verdicts_table

NAME = "Table I, DSC3D rows"
ABOUT = tuple(claim for claim in CLAIMS if claim.dataset == DSC3D)
REFERENCES = ("circular", "true")
"""What the references are called where there are both: the paper's kind, which ECSRC made, and the truth."""


@dataclass(frozen=True, eq=False)
class Beside:
    """What the page says of DSC3D."""

    sections: tuple[Section, ...]
    notes: tuple[str, ...]
    numbers: tuple[pd.DataFrame, ...]
    claims: tuple[pd.DataFrame, ...]
    """By reference; their first is the one that counts."""


def of_dsc3d(runs: tuple[MetricsData, ...]) -> Beside:
    """Return sections, notes, numbers and claims of the runs for DSC3D; nothing without any."""
    if not runs:
        return Beside((), (), (), ())
    title = f"{NAME}{_standing_in(runs[0])}"
    calls = REFERENCES if len(runs) == len(REFERENCES) else ("",)
    means = {called: bootstrap(run.part(run.classes[0])) for called, run in zip(calls, runs, strict=True)}
    shared = frozenset.intersection(*(made.variants for made in means.values()))
    rows = tuple(row for row in TABLE_I_DSC3D if row.variant in shared)
    verdicts = {called: [check(claim, made, DSC3D) for claim in ABOUT] for called, made in means.items()}
    line = _line(dict(zip(calls, runs, strict=True)))
    return Beside(
        sections=(
            *beside(title, rows, {_ours(called): made for called, made in means.items()}, line),
            Section(f"What the paper claims of DSC3D{_standing_in(runs[0])}", verdicts_table(verdicts), line),
        ),
        notes=_notes(runs),
        numbers=tuple(
            numbers(title, rows, run.classes[0], made, run.dataset)
            for run, made in zip(runs, means.values(), strict=True)
        ),
        claims=tuple(
            verdicts_table({called: found}).assign(data=run.dataset)
            for run, (called, found) in zip(runs, verdicts.items(), strict=True)
        ),
    )


def _standing_in(run: MetricsData) -> str:
    """Return what a title has to add if the data is not DSC3D."""
    if run.dataset == DSC3D:
        return ""
    return " (synthetic stand-in)" if run.dataset.startswith("synthetic") else " (stand-in)"


def _ours(called: str) -> str:
    return f"ours ({called})" if called else "ours"


def _line(runs: Mapping[str, MetricsData]) -> str:
    return " ".join(
        f"{called.capitalize()}: {run.line}" if called else run.line for called, run in runs.items()
    )


def _notes(runs: tuple[MetricsData, ...]) -> tuple[str, ...]:
    if runs[0].dataset == DSC3D:
        return ()
    truth = " The figures by the truth stand beside them." if len(runs) > 1 else ""
    return (
        f"The rows of DSC3D stand beside another data set: {runs[0].dataset}. As in the paper, ECSRC had a "
        f"part in the reference, which suits a method that begins with it.{truth} What makes RGT's 15.411 m "
        "on terrain, the paper does not tell.",
    )
