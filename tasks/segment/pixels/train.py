"""Train the model of `pixels`: gradient-boosted trees on some cells of each tile.

Road is rare, so half of the cells drawn from a tile are road as far as it has any; weights give the shares
back, so that what the model tells is a probability. When to stop and where the threshold lies is found on
strips of training tiles set apart in turn: from a few validation tiles it would be theirs alone, and what is
told of these is told of ground that had no part in the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flexroad.catalog.grid import Grid
from flexroad.tasks import options
from flexroad.tasks.errors import TaskError
from flexroad.tasks.segment.pixels.features import features, look
from flexroad.tasks.segment.pixels.model import About, Model, require
from flexroad.tasks.segment.training_types import Progress, Round, Sample, Trained
from flexroad.tasks.types import Bools, Floats

BINS = 63
"""Values of a feature are told apart by so many quantiles; more take longer to find than to learn from."""


class Options(options.Options):
    """What is looked at, and how the trees learn."""

    photo: bool | None = Field(
        None, description="learn colours, too; null: if the first tile has an orthophoto"
    )
    cells: int = Field(12000, ge=100, description="cells drawn from a tile at most, half of them road")
    rounds: int = Field(200, ge=1, le=5000, description="trees at most")
    patience: int = Field(
        50, ge=1, description="rounds without gain in IoU on what is set apart before the end"
    )
    folds: int = Field(5, ge=2, le=20, description="strips of training tiles that are set apart in turn")
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
    tile: NDArray[np.intp]
    """Index of each cell's tile, ``(n,)``."""
    tiles: tuple[tuple[str, Grid], ...]

    def __getitem__(self, which: Bools) -> _Cells:
        """Return some of the cells."""
        return replace(
            self,
            features=self.features[which],
            road=self.road[which],
            weight=self.weight[which],
            tile=self.tile[which],
        )

    @property
    def has_colours(self) -> bool:
        """Whether some features are of a photo."""
        return "light" in self.names

    @property
    def has_both(self) -> bool:
        """Whether there is road and something else."""
        return bool(self.road.any() and not self.road.all())


def train(
    train: Sequence[Sample],
    validate: Sequence[Sample],
    options: Options,
    progress: Progress | None = None,
) -> Trained:
    """Learn to tell road from the rest.

    The validation tiles are only told of in the history and in the model's provenance, unless there is but
    one tile to train on: then they are what is set apart.

    Raises
    ------
    TaskError
        If scikit-learn or skops is missing, there is no tile to train or to validate on, one lacks the
        orthophoto that others have, or the labels know only one kind of cell.
    """
    require()
    learnt = _draw(train, options, "training")
    judged = _draw(validate, options.model_copy(update={"photo": learnt.has_colours}), "validation")
    rounds, threshold, expected = _set_apart(learnt, judged, options)
    classifier = _fit(learnt, judged, rounds, options)
    history = tuple(
        Round(-float(a), -float(b))
        for a, b in zip(classifier.train_score_[1:], classifier.validation_score_[1:], strict=True)
    )
    if progress is not None:
        progress(rounds, rounds, history[-1])
    facts: dict[str, str | int | float] = {
        "train_tiles": " ".join(name for name, _ in learnt.tiles),
        "validation_tiles": " ".join(name for name, _ in judged.tiles),
        "train_cells": len(learnt.road),
        "train_road_cells": int(learnt.road.sum()),
        "expected_iou": expected,
        "validation_loss": history[-1].validation_loss,
        "rounds": rounds,
        "options": options.model_dump_json(),
    }
    return Trained(_model(classifier, learnt, threshold, facts).encode(), ".skops", history)


def _set_apart(learnt: _Cells, judged: _Cells, options: Options) -> tuple[int, float, float]:
    """Return rounds and threshold that serve ground that was not learnt from, and the IoU to expect.

    Rounds are told by IoU: on other ground a few cells that are surely wrong spoil the mean loss long before
    the mask gets worse.
    """
    strips = _strips([grid for _, grid in learnt.tiles], options.folds)[learnt.tile]
    pairs = [(learnt[strips != k], learnt[strips == k]) for k in range(strips.max() + 1)]
    pairs = [(rest, apart) for rest, apart in pairs if rest.has_both] or [(learnt, judged)]
    road = np.concatenate([apart.road for _, apart in pairs])
    weight = np.concatenate([apart.weight for _, apart in pairs])
    told = [
        _fit(rest, apart, options.rounds, options).staged_predict_proba(apart.features)
        for rest, apart in pairs
    ]
    best = (0, 0.5, -1.0)
    for done, parts in enumerate(zip(*told, strict=True), start=1):
        threshold, iou = even_threshold(np.concatenate([part[:, 1] for part in parts]), road, weight)
        if iou > best[2]:
            best = done, threshold, iou
        elif done - best[0] >= options.patience:
            break
    return best


def _strips(grids: Sequence[Grid], most: int) -> NDArray[np.intp]:
    """Cut tiles into strips across their longer extent; return each tile's strip, ``(n,)``.

    One strip if all lie at one place.
    """
    places = np.array([(grid.west, grid.north) for grid in grids])
    along = places[:, np.argmax(np.ptp(places, axis=0))]
    # Neighbours across the strip share its number.
    level = np.unique(along, return_inverse=True)[1]
    strips: NDArray[np.intp] = level * min(most, level.max() + 1) // (level.max() + 1)
    return strips


def even_threshold(probability: Floats, road: Bools, weight: Floats) -> tuple[float, float]:
    """Return the probability from which as many cells count as road as are road, and the IoU there.

    IoU is flat around its best threshold, and where on the plateau the best lies is chance; from this one
    on, misses and false alarms balance, and area is right.
    """
    order = np.argsort(-probability, kind="stable")
    ranked, called, hit = probability[order], np.cumsum(weight[order]), np.cumsum((weight * road)[order])
    last = int(np.searchsorted(called, hit[-1]))
    # Cells of one probability are called together.
    last = int(np.searchsorted(-ranked, -ranked[last], side="right")) - 1
    below = ranked[last + 1] if last + 1 < len(ranked) else 0.0
    threshold = float(np.clip((ranked[last] + below) / 2, 0.01, 0.99))
    return threshold, float(hit[last] / (called[last] + hit[-1] - hit[last]))


def _fit(learnt: _Cells, judged: _Cells, rounds: int, options: Options) -> Any:
    from sklearn.ensemble import HistGradientBoostingClassifier

    classifier = HistGradientBoostingClassifier(
        max_iter=rounds,
        learning_rate=options.learning_rate,
        max_leaf_nodes=options.leaves,
        min_samples_leaf=options.leaf_cells,
        l2_regularization=options.smooth,
        max_features=options.share,
        max_bins=BINS,
        # It never stops early: so that it tells the losses of all rounds.
        early_stopping=True,
        n_iter_no_change=rounds,
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
        photo=learnt.has_colours,
        cell_m=learnt.tiles[0][1].cell,
        threshold=threshold,
        scikit_learn=__version__,
        trained=facts,
    )
    return Model(classifier, about)


def _draw(samples: Sequence[Sample], options: Options, name: str) -> _Cells:
    """Draw cells of every tile, one tile at a time."""
    wanted = options.photo
    names: tuple[str, ...] = ()
    values, roads, weights, of, tiles = [], [], [], [], []
    for k in range(len(samples)):
        sample = samples[k]
        data = sample.data
        photo = None if wanted is False else look(data)
        wanted = photo is not None if wanted is None else wanted
        if wanted and photo is None:
            raise TaskError(
                f"tile {data.tile_id} has no orthophoto (layer dop): give --dop to `flexroad catalog "
                "rasters`, leave the tile out, or learn from heights alone (--set photo=false)",
                layer="dop",
            )
        found = features(data, photo)
        names = found.names
        rng = np.random.default_rng([options.seed, k])
        index, weight = _some(sample, options.cells, rng)
        values.append(found.values.reshape(len(names), -1)[:, index].T)
        roads.append(sample.road.ravel()[index])
        weights.append(weight)
        of.append(np.full(len(index), k))
        tiles.append((data.tile_id, data.core))
    if not tiles:
        raise TaskError(f"no {name} tiles; use more tiles")
    cells = _Cells(
        names,
        np.concatenate(values),
        np.concatenate(roads),
        np.concatenate(weights),
        np.concatenate(of),
        tuple(tiles),
    )
    if not cells.has_both:
        raise TaskError(f"the {name} tiles have no labels of road and of something else; use more tiles")
    return cells


def _some(sample: Sample, most: int, rng: np.random.Generator) -> tuple[NDArray[np.intp], Floats]:
    """Draw cells whose label counts, at most half of ``most`` of each kind, and what each stands for."""
    index, weight = [], []
    for kind in (True, False):
        there = np.flatnonzero(sample.known & (sample.road == kind))
        n = min(len(there), most // 2)
        index.append(np.sort(rng.choice(there, n, replace=False)))
        weight.append(np.full(n, len(there) / max(n, 1)))
    return np.concatenate(index), np.concatenate(weight)
