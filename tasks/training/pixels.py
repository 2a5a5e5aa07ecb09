"""Train the model of `pixels`: gradient-boosted trees on some cells of each tile.

Road is rare, so half of the cells drawn from a tile are road as far as it has any; weights give the shares
back, so that what the model tells is a probability. Validation tiles, which lie apart, say when to stop and
where the threshold is best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from tasks import options
from tasks.errors import TaskError
from tasks.pixel_features import features, look
from tasks.pixel_model import About, Model
from tasks.training.types import Progress, Round, Sample, Trained
from tasks.types import Bools, Floats


class Options(options.Options):
    """What is looked at, and how the trees learn."""

    photo: bool | None = Field(
        None, description="learn colours, too; null: if the first tile has an orthophoto"
    )
    cells: int = Field(12000, ge=100, description="cells drawn from a tile at most, half of them road")
    rounds: int = Field(200, ge=1, le=5000, description="trees at most")
    patience: int = Field(20, ge=1, description="rounds without gain on the validation tiles before the end")
    learning_rate: float = Field(0.1, gt=0, le=1, description="share of each tree that counts")
    leaves: int = Field(15, ge=2, le=255, description="leaves of a tree")
    leaf_cells: int = Field(100, ge=1, description="cells in a leaf at least")
    smooth: float = Field(5.0, ge=0, description="L2 penalty on the values of leaves")
    share: float = Field(0.3, gt=0, le=1, description="share of the features that each split may look at")
    seed: int = Field(0, ge=0, description="of the draws")


@dataclass(frozen=True, eq=False)
class _Cells:
    """Cells with labels."""

    names: tuple[str, ...]
    features: NDArray[np.float32]
    """``(n, features)``."""
    road: Bools
    weight: Floats
    """How many cells of its tile each stands for, ``(n,)``."""
    tiles: tuple[str, ...]
    cell_m: float


def train(
    train: Sequence[Sample],
    validate: Sequence[Sample],
    options: Options,
    progress: Progress | None = None,
) -> Trained:
    """Learn to tell road from the rest; stop when the validation tiles gain no more.

    Raises
    ------
    TaskError
        If there is no tile to train or to validate on, one lacks the orthophoto that others have, or the
        labels know only one kind of cell.
    """
    learnt = _draw(train, options, "training")
    judged = _draw(validate, options.model_copy(update={"photo": _has_colours(learnt)}), "validation")
    classifier = _fit(learnt, judged, options)
    history = tuple(
        Round(-float(a), -float(b))
        for a, b in zip(classifier.train_score_[1:], classifier.validation_score_[1:], strict=True)
    )
    if progress is not None:
        progress(len(history), options.rounds, history[-1])
    threshold, iou = best_threshold(
        classifier.predict_proba(judged.features)[:, 1], judged.road, judged.weight
    )
    facts: dict[str, str | int | float] = {
        "train_tiles": " ".join(learnt.tiles),
        "validation_tiles": " ".join(judged.tiles),
        "train_cells": len(learnt.road),
        "train_road_cells": int(learnt.road.sum()),
        "validation_loss": min(past.validation_loss for past in history),
        "validation_iou": iou,
        "rounds": len(history),
        "options": options.model_dump_json(),
    }
    return Trained(_model(classifier, learnt, threshold, facts).encode(), ".skops", history)


def best_threshold(probability: Floats, road: Bools, weight: Floats) -> tuple[float, float]:
    """Return the probability from which cells count as road for the best IoU, and that IoU."""
    order = np.argsort(-probability, kind="stable")
    ranked = probability[order]
    hit = np.cumsum(np.where(road, weight, 0)[order])
    called = np.cumsum(weight[order])
    iou = hit / (called + np.where(road, weight, 0).sum() - hit)
    # Cells of one probability are called together.
    iou[:-1][ranked[1:] == ranked[:-1]] = 0
    best = int(np.argmax(iou))
    below = ranked[best + 1] if best + 1 < len(ranked) else ranked[best]
    threshold = float(np.clip((ranked[best] + below) / 2, 0.01, 0.99))
    return threshold, float(iou[best])


def _fit(learnt: _Cells, judged: _Cells, options: Options) -> Any:
    from sklearn.ensemble import HistGradientBoostingClassifier

    classifier = HistGradientBoostingClassifier(
        max_iter=options.rounds,
        learning_rate=options.learning_rate,
        max_leaf_nodes=options.leaves,
        min_samples_leaf=options.leaf_cells,
        l2_regularization=options.smooth,
        max_features=options.share,
        early_stopping=True,
        n_iter_no_change=options.patience,
        random_state=options.seed,
    )
    return classifier.fit(
        learnt.features,
        learnt.road,
        # Around 1, or the penalty on leaves would mean something else on other tiles.
        sample_weight=learnt.weight / learnt.weight.mean(),
        X_val=judged.features,
        y_val=judged.road,
        sample_weight_val=judged.weight / judged.weight.mean(),
    )


def _model(classifier: Any, learnt: _Cells, threshold: float, facts: dict[str, str | int | float]) -> Model:
    from sklearn import __version__

    about = About(
        features=learnt.names,
        photo=_has_colours(learnt),
        cell_m=learnt.cell_m,
        threshold=threshold,
        scikit_learn=__version__,
        trained=facts,
    )
    return Model(classifier, about)


def _has_colours(cells: _Cells) -> bool:
    return "light" in cells.names


def _draw(samples: Sequence[Sample], options: Options, name: str) -> _Cells:
    """Draw cells of every tile, one tile at a time."""
    wanted = options.photo
    names: tuple[str, ...] = ()
    values, roads, weights, tiles = [], [], [], []
    for k in range(len(samples)):
        sample = samples[k]
        data = sample.data
        photo = None if wanted is False else look(data)
        wanted = photo is not None if wanted is None else wanted
        if wanted and photo is None:
            raise TaskError(
                f"tile {data.tile_id} has no orthophoto (layer dop): give --dop to `flexroad catalog "
                "rasters`, leave the tile out, or learn from heights alone (photo: false)",
                layer="dop",
            )
        found = features(data, photo)
        names = found.names
        rng = np.random.default_rng([options.seed, k])
        index, weight = _some(sample, options.cells, rng)
        values.append(found.values.reshape(len(names), -1)[:, index].T)
        roads.append(sample.road.ravel()[index])
        weights.append(weight)
        tiles.append(data.tile_id)
    road = np.concatenate(roads) if roads else np.zeros(0, bool)
    if not 0 < np.count_nonzero(road) < len(road):
        raise TaskError(f"the {name} tiles have no labels of road and of something else; use more tiles")
    cell_m = samples[0].data.grid.cell
    return _Cells(names, np.concatenate(values), road, np.concatenate(weights), tuple(tiles), cell_m)


def _some(sample: Sample, most: int, rng: np.random.Generator) -> tuple[NDArray[np.intp], Floats]:
    """Draw cells whose label counts, at most half of ``most`` of each kind, and what each stands for."""
    index, weight = [], []
    for kind in (True, False):
        there = np.flatnonzero(sample.known & (sample.road == kind))
        n = min(len(there), most // 2)
        index.append(np.sort(rng.choice(there, n, replace=False)))
        weight.append(np.full(n, len(there) / max(n, 1)))
    return np.concatenate(index), np.concatenate(weight)
