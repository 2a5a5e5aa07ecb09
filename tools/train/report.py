"""The report on a trained model: MODEL.html with tables and pictures, MODEL.json for programs."""

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
from flexroad.catalog.text import count
from flexroad.pipeline.run.record import versions
from flexroad.pipeline.store.records import no_nan
from flexroad.tools.report.pages import template
from flexroad.tools.report.render import curves, segmentation_map
from flexroad.tools.train.driver import Outcome
from flexroad.tools.train.mask_metrics import Quality

SHOWN = 3
"""Number of best and of worst tiles in the report."""
POOR_IOU = 0.5
"""IoU below which a model is called poor. If precision equals recall, a third of the marked cells is wrong
at 0.5, half of them at 0.33. Centre lines with one width for all roads reach 0.65 to 0.75."""
COLUMNS = {
    "iou": "IoU",
    "precision": "precision",
    "recall": "recall",
    "f1": "F1",
    "edge_mean_m": "edge, mean (m)",
    "edge_p95_m": "edge, p95 (m)",
}
MEANING = (
    "Quality of the model's mask before cleanup, on all surveyed cells. Edges: distance from each piece "
    "of the segmented outline to the nearest labelled one, and vice versa; a false road far from any "
    "true road counts with its full distance."
)


def write_model(outcome: Outcome, path: Path) -> tuple[Path, ...]:
    """Write the report and the model; return the paths, the model first.

    - `path`: path of the model; without a suffix, ``.safetensors`` is added.
    """
    path = path if path.suffix else path.with_suffix(".safetensors")
    html, record = path.with_name(f"{path.name}.html"), path.with_name(f"{path.name}.json")
    write(html, _page(outcome, path.name).encode())
    write(record, json.dumps(_record(outcome), indent=1).encode())
    write(path, outcome.model)
    return path, html, record


def summary(outcome: Outcome) -> str:
    """Return the quality in one line."""
    overall = outcome.quality
    return (
        f"IoU {overall.iou:.3f}, precision {overall.precision:.3f}, recall {overall.recall:.3f}, "
        f"F1 {overall.f1:.3f}, "
        f"edges {overall.edge_mean_m:.2f} m off on average (p95 {overall.edge_p95_m:.2f} m)"
    )


def verdict(outcome: Outcome) -> str:
    """Return the reason against using the model, and advice; empty if it can be used."""
    iou = outcome.quality.iou
    if math.isnan(iou):
        return (
            "the validation tiles have no road, by their labels and by the model, so that its quality is "
            "unknown; label tiles with roads, or choose others with --seed"
        )
    if iou >= POOR_IOU:
        return ""
    return (
        f"an IoU of {iou:.2f} is poor (below {POOR_IOU:g}): much of what the model marks is no road, or it "
        "misses much of the road; label more tiles and other kinds of ground, compare labels and pictures in "
        "the report, or take roads from vectors (segment: vector)"
    )


def _figures(quality: Quality) -> dict[str, float]:
    return {name: getattr(quality, name) for name in COLUMNS}


def _page(outcome: Outcome, name: str) -> str:
    rows = [
        ("all cells", outcome.quality),
        (f"{outcome.tiles.options.ignore_m:g} m off label edges", outcome.inner),
    ]
    overall = pd.DataFrame([{"cells": cells} | _figures(quality) for cells, quality in rows])
    per_tile = pd.DataFrame(
        [
            {"tile": evaluation.piece.tile.id, "road": _share(evaluation.quality)}
            | _figures(evaluation.quality)
            for evaluation in outcome.judged
        ]
    )
    return template("training.html.j2", Path(__file__).parent).render(
        title=f"Road model {name}",
        state=summary(outcome),
        lines=_lines(outcome),
        sections=[
            ("Validation tiles, together", overall.rename(columns=COLUMNS), MEANING),
            ("Validation tiles, one by one", per_tile.rename(columns=COLUMNS), ""),
        ],
        curves=list(_curves(outcome)),
        tiles=list(_pictures(outcome)),
        notes=outcome.notes,
        options=yaml.safe_dump(_options(outcome), sort_keys=False),
        versions=versions(),
    )


def _lines(outcome: Outcome) -> list[str]:
    options, split = outcome.tiles.options, outcome.split
    warning = verdict(outcome)
    return [
        *([f"Warning: {warning}."] if warning else []),
        f"Labels: {options.labels}. Trained on {count(len(split.train), 'tile')}, "
        f"validated on {len(split.validate)} in one separate block. Not used for training: cells nearer to "
        f"the block than {options.gap_m:g} m, and cells nearer to an edge of the labels than "
        f"{options.ignore_m:g} m.",
        "Expect lower quality on land that looks different. The stopping point and the threshold are chosen "
        "on the validation tiles, so the figures are slightly optimistic.",
    ]


def _curves(outcome: Outcome) -> Iterator[tuple[str, bytes]]:
    overall = outcome.quality
    _, precision, recall = overall.curve()
    valid = np.isfinite(precision) & np.isfinite(recall)
    # A curve needs at least two points.
    if valid.sum() > 1:
        mark = None if math.isnan(overall.precision) else (overall.recall, overall.precision, "the mask")
        line = {"thresholds from 0 to 1": (recall[valid], precision[valid])}
        limits = ((0.0, 1.02), (0.0, 1.02))
        yield "Precision and recall by threshold", curves(line, ("recall", "precision"), limits, mark)
    history = outcome.history
    if len(history) > 1:
        epochs = np.arange(1.0, len(history) + 1)
        named = zip(("training", "validation"), np.array(history).T, strict=True)
        losses = {name: (epochs, values) for name, values in named}
        yield "Loss by epoch", curves(losses, ("epoch", "loss"))


def _pictures(outcome: Outcome) -> Iterator[tuple[str, bytes]]:
    """Yield caption and picture of the best tiles, then of the worst, each tile once."""
    with_road = (evaluation for evaluation in outcome.judged if not math.isnan(evaluation.quality.iou))
    ranked = sorted(with_road, key=lambda evaluation: -evaluation.quality.iou)
    worst = max(SHOWN, len(ranked) - SHOWN)
    for rank, evaluation in enumerate(ranked):
        if rank < SHOWN or rank >= worst:
            iou = evaluation.quality.iou
            caption = f"{evaluation.piece.tile.id}: IoU {iou:.3f} ({rank + 1} of {len(ranked)})"
            yield caption, segmentation_map(*outcome.preview(evaluation))


def _share(quality: Quality) -> float:
    """Return the share of road cells."""
    road = quality.right + quality.missed
    return road / max(1, road + quality.wrong + quality.ground)


def _options(outcome: Outcome) -> dict[str, Any]:
    """Return the training options and the ids of the tiles of both sides."""
    return asdict(outcome.tiles.options) | {
        "learnt from": [piece.tile.id for piece in outcome.split.train],
        "judged by": [piece.tile.id for piece in outcome.split.validate],
    }


def _record(outcome: Outcome) -> dict[str, Any]:
    """Return the content of MODEL.json: options, figures, curves and versions."""
    thresholds, precision, recall = outcome.quality.curve()
    return {
        "model_sha256": hashlib.sha256(outcome.model).hexdigest(),
        "asked": _options(outcome),
        "all": no_nan(_figures(outcome.quality)),
        "off_label_edges": no_nan(_figures(outcome.inner)),
        "tiles": {
            evaluation.piece.tile.id: no_nan(_figures(evaluation.quality)) for evaluation in outcome.judged
        },
        "curve": {
            "threshold": thresholds.tolist(),
            "precision": [None if math.isnan(value) else value for value in precision.tolist()],
            "recall": [None if math.isnan(value) else value for value in recall.tolist()],
        },
        "history": [
            no_nan({"train_loss": loss, "validation_loss": validation})
            for loss, validation in outcome.history
        ],
        "notes": list(outcome.notes),
        "versions": versions(),
    }
