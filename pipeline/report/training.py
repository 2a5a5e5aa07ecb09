"""The report on a trained model: MODEL.html for people, MODEL.json for programs."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from flexroad.catalog.storage.paths import write
from flexroad.pipeline.report.pages import template
from flexroad.pipeline.report.render import curves, found_map
from flexroad.pipeline.run.record import versions
from flexroad.pipeline.store.products import no_nan
from flexroad.pipeline.training.train import Evaluation, Outcome
from flexroad.tasks.roads.mask_metrics import Quality

SHOWN = 3
"""Best tiles shown, and as many of the worst."""
COLUMNS = {
    "iou": "IoU",
    "precision": "precision",
    "recall": "recall",
    "f1": "F1",
    "edge_mean_m": "edge, mean (m)",
    "edge_p95_m": "edge, p95 (m)",
}


def write_model(outcome: Outcome, path: Path) -> tuple[Path, ...]:
    """Write the report and the model; return the files, the model first.

    Parameters
    ----------
    path : Path
        The model's; without a suffix it gets its kind's.

    Raises
    ------
    OSError
        If one cannot be written. The model comes last: where it is, its report is.
    """
    path = path if path.suffix else path.with_suffix(outcome.trained.suffix)
    page, facts = path.with_name(f"{path.name}.html"), path.with_name(f"{path.name}.json")
    write(page, _page(outcome, path.name).encode())
    write(facts, json.dumps(_facts(outcome), indent=1).encode())
    write(path, outcome.trained.model)
    return path, page, facts


def summary(outcome: Outcome) -> str:
    """Return the figures in one line."""
    whole = outcome.quality
    return (
        f"IoU {whole.iou:.3f}, precision {whole.precision:.3f}, recall {whole.recall:.3f}, "
        f"F1 {whole.f1:.3f}, edges {whole.edge_mean_m:.2f} m off on average (p95 {whole.edge_p95_m:.2f} m)"
    )


def _figures(quality: Quality) -> dict[str, float]:
    return {name: getattr(quality, name) for name in COLUMNS}


def _page(outcome: Outcome, name: str) -> str:
    asked, split = outcome.options, outcome.split
    rows = [("all cells", outcome.quality), (f"{asked.ignore_m:g} m off label edges", outcome.inner)]
    overall = pd.DataFrame([{"cells": what} | _figures(quality) for what, quality in rows])
    per_tile = pd.DataFrame(
        [
            {"tile": one.piece.tile.id, "road": _share(one.quality)} | _figures(one.quality)
            for one in outcome.judged
        ]
    )
    count = f"{len(split.train)} tile{'s' * (len(split.train) != 1)}"
    return template("training.html.j2").render(
        title=f"Road model {name}",
        state=summary(outcome),
        lines=_lines(outcome, count),
        sections=[
            ("Tiles to judge by, together", overall.rename(columns=COLUMNS), _meaning(outcome)),
            ("Tile by tile", per_tile.rename(columns=COLUMNS), ""),
        ],
        curves=list(_curves(outcome)),
        tiles=list(_pictures(outcome)),
        notes=outcome.notes,
        asked=yaml.safe_dump(_asked(outcome), sort_keys=False),
        versions=versions(),
    )


def _lines(outcome: Outcome, count: str) -> list[str]:
    asked, split = outcome.options, outcome.split
    return [
        f"Method {asked.method}, labels: {asked.labels}. Learnt from {count}, judged by "
        f"{len(split.validate)} in one block apart; not learnt from: cells nearer to it than "
        f"{asked.gap_m:g} m, and nearer to an edge of the labels than {asked.ignore_m:g} m.",
        "Expect less on land that looks otherwise. dinov2 chooses when to stop and its threshold by the "
        "tiles to judge by, which flatters it a little; pixels does so by parts of the tiles to learn from.",
    ]


def _meaning(outcome: Outcome) -> str:
    return (
        "Of the mask as the model gives it, before cleanup, on all surveyed cells. Edges: from each piece of "
        "the found outline to the nearest of the labels' and the other way round; a false road far from any "
        "true one counts with its whole distance."
    )


def _curves(outcome: Outcome) -> Iterator[tuple[str, bytes]]:
    whole = outcome.quality
    _, precision, recall = whole.curve()
    known = np.isfinite(precision) & np.isfinite(recall)
    if known.any():
        here = None if math.isnan(whole.precision) else (whole.recall, whole.precision, "the mask")
        line = {"thresholds from 0 to 1": (recall[known], precision[known])}
        limits = ((0.0, 1.02), (0.0, 1.02))
        yield "Precision and recall by threshold", curves(line, ("recall", "precision"), limits, here)
    history = outcome.trained.history
    if history:
        rounds = np.arange(1.0, len(history) + 1)
        losses = {
            "to learn from": (rounds, np.array([one.train_loss for one in history])),
            "to judge by": (rounds, np.array([one.validation_loss for one in history])),
        }
        yield "Loss by round", curves(losses, ("round", "loss"))


def _pictures(outcome: Outcome) -> Iterator[tuple[str, bytes]]:
    """Draw the best tiles, then the worst, each once."""
    ranked = sorted(
        (one for one in outcome.judged if not math.isnan(one.quality.iou)), key=lambda one: -one.quality.iou
    )
    worst = max(SHOWN, len(ranked) - SHOWN)
    for rank, one in enumerate(ranked):
        if rank < SHOWN or rank >= worst:
            caption = f"{one.piece.tile.id}: IoU {one.quality.iou:.3f} ({rank + 1} of {len(ranked)})"
            yield caption, _picture(outcome, one)


def _picture(outcome: Outcome, one: Evaluation) -> bytes:
    preview = outcome.preview(one)
    return found_map(preview.ground, preview.truth, preview.predicted, preview.grid)


def _share(quality: Quality) -> float:
    road = quality.right + quality.missed
    return road / max(1, road + quality.wrong + quality.ground)


def _asked(outcome: Outcome) -> dict[str, Any]:
    return asdict(outcome.options) | {
        "learnt from": [piece.tile.id for piece in outcome.split.train],
        "judged by": [piece.tile.id for piece in outcome.split.validate],
    }


def _facts(outcome: Outcome) -> dict[str, Any]:
    """Return everything the page tells in figures."""
    thresholds, precision, recall = outcome.quality.curve()
    return {
        "model_sha256": hashlib.sha256(outcome.trained.model).hexdigest(),
        "asked": _asked(outcome),
        "all": no_nan(_figures(outcome.quality)),
        "off_label_edges": no_nan(_figures(outcome.inner)),
        "tiles": {one.piece.tile.id: no_nan(_figures(one.quality)) for one in outcome.judged},
        "curve": {
            "threshold": thresholds.tolist(),
            "precision": [None if math.isnan(value) else value for value in precision.tolist()],
            "recall": [None if math.isnan(value) else value for value in recall.tolist()],
        },
        "history": [no_nan(asdict(one)) for one in outcome.trained.history],
        "notes": list(outcome.notes),
        "versions": versions(),
    }
