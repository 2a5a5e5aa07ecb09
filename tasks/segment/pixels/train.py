"""Train the model of `pixels`: gradient-boosted trees on some cells of each tile.

Road is rare, so half of the cells drawn from a tile are road if it has enough; weights restore the true
fractions, so that the model predicts probabilities. The number of rounds and the threshold come from
cross-validation over strips of training tiles. The validation tiles do not influence the model, so their
metrics are independent of it.
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
from flexroad.tasks.segment.pixels.features import features, read_tile_photo
from flexroad.tasks.segment.pixels.model import About, encode, require
from flexroad.tasks.segment.pixels.trees import MOST_LEAVES, MOST_TREES
from flexroad.tasks.segment.training_types import Progress, Round, Sample, Trained
from flexroad.tasks.types import Bools, Floats

BINS = 63
"""Number of quantile bins per feature; binning with more takes longer than the training."""


class Options(options.Options):
    """Features, sampling of the cells, and training of the trees."""

    photo: bool | None = Field(
        None, description="use colours, too; null: if the first tile has an orthophoto"
    )
    cells: int = Field(
        12000, ge=100, description="greatest number of cells drawn per tile, half of them road"
    )
    rounds: int = Field(200, ge=1, le=MOST_TREES, description="greatest number of trees")
    patience: int = Field(
        50, ge=1, description="stop after this many rounds without a better IoU on the held-out strips"
    )
    folds: int = Field(5, ge=2, le=20, description="strips of training tiles, each held out once")
    learning_rate: float = Field(
        0.1, gt=0, le=1, description="learning rate: factor on the values of each tree"
    )
    leaves: int = Field(15, ge=2, le=MOST_LEAVES, description="greatest number of leaves per tree")
    leaf_cells: int = Field(100, ge=1, description="least number of cells in a leaf")
    smooth: float = Field(5.0, ge=0, description="L2 penalty on leaf values")
    share: float = Field(0.3, gt=0, le=1, description="fraction of the features that each split chooses from")
    seed: int = Field(0, ge=0, description="seed of the random draws")


@dataclass(frozen=True, eq=False)
class _Cells:
    """Labelled cells with their features."""

    names: tuple[str, ...]
    features: NDArray[np.float32]
    """``(n, features)``."""
    road: Bools
    weight: Floats
    """Number of cells of its tile that each cell represents, ``(n,)``."""
    tile: NDArray[np.intp]
    """Index of each cell's tile, ``(n,)``."""
    tiles: tuple[tuple[str, Grid], ...]
    """Id and core of each tile."""

    def __getitem__(self, which: Bools) -> _Cells:
        """Return a subset of the cells."""
        return replace(
            self,
            features=self.features[which],
            road=self.road[which],
            weight=self.weight[which],
            tile=self.tile[which],
        )

    @property
    def has_colours(self) -> bool:
        """Whether some features come from a photo."""
        return "light" in self.names

    @property
    def has_both(self) -> bool:
        """Whether the cells include both road and other ground."""
        return bool(self.road.any() and not self.road.all())


def train(
    train: Sequence[Sample],
    validate: Sequence[Sample],
    options: Options,
    progress: Progress | None = None,
) -> Trained:
    """Train a classifier of road cells.

    The validation tiles only give the losses of the history and of the model's provenance. Exception: with a
    single training tile they also give the number of rounds and the threshold.

    Raises
    ------
    TaskError
        If scikit-learn or skops is missing, there are no training or no validation tiles, a tile lacks the
        orthophoto that others have, or the labels do not include both road and other ground.
    """
    require()
    train_cells = _draw(train, options, "training")
    same_features = options.model_copy(update={"photo": train_cells.has_colours})
    validation_cells = _draw(validate, same_features, "validation")
    rounds, threshold, expected = _cross_validate(train_cells, validation_cells, options)
    classifier = _fit(train_cells, validation_cells, rounds, options)
    history = tuple(
        Round(-float(a), -float(b))
        for a, b in zip(classifier.train_score_[1:], classifier.validation_score_[1:], strict=True)
    )
    if progress is not None:
        progress(rounds, rounds, history[-1])
    facts: dict[str, str | int | float] = {
        "train_tiles": " ".join(name for name, _ in train_cells.tiles),
        "validation_tiles": " ".join(name for name, _ in validation_cells.tiles),
        "train_cells": len(train_cells.road),
        "train_road_cells": int(train_cells.road.sum()),
        "expected_iou": expected,
        "validation_loss": history[-1].validation_loss,
        "rounds": rounds,
        "options": options.model_dump_json(),
    }
    return Trained(_model(classifier, train_cells, threshold, facts), ".skops", history)


def _cross_validate(train: _Cells, validation: _Cells, options: Options) -> tuple[int, float, float]:
    """Return the number of rounds and the threshold with the best IoU on held-out strips, and that IoU.

    IoU, not the loss, decides: on held-out ground a few cells that are confidently wrong raise the mean loss
    long before the mask gets worse.
    """
    strips = _strips([grid for _, grid in train.tiles], options.folds)[train.tile]
    folds = [(train[strips != k], train[strips == k]) for k in range(strips.max() + 1)]
    folds = [(rest, held_out) for rest, held_out in folds if rest.has_both] or [(train, validation)]
    road = np.concatenate([held_out.road for _, held_out in folds])
    weight = np.concatenate([held_out.weight for _, held_out in folds])
    predictions = [
        _fit(rest, held_out, options.rounds, options).staged_predict_proba(held_out.features)
        for rest, held_out in folds
    ]
    best = (0, 0.5, -1.0)
    for rounds, parts in enumerate(zip(*predictions, strict=True), start=1):
        threshold, iou = even_threshold(np.concatenate([part[:, 1] for part in parts]), road, weight)
        if iou > best[2]:
            best = rounds, threshold, iou
        elif rounds - best[0] >= options.patience:
            break
    return best


def _strips(grids: Sequence[Grid], most: int) -> NDArray[np.intp]:
    """Divide tiles into strips across their longer extent; return the strip number of each tile, ``(n,)``.

    There is one strip if all tiles lie at the same place.
    """
    corners = np.array([(grid.west, grid.north) for grid in grids])
    along = corners[:, np.argmax(np.ptp(corners, axis=0))]
    # Tiles side by side across a strip have the same number.
    level = np.unique(along, return_inverse=True)[1]
    strips: NDArray[np.intp] = level * min(most, level.max() + 1) // (level.max() + 1)
    return strips


def even_threshold(probability: Floats, road: Bools, weight: Floats) -> tuple[float, float]:
    """Return the threshold at which the predicted road area equals the true one, and the IoU there.

    IoU is flat around its maximum, so the position of the maximum is random. At this threshold misses and
    false alarms balance.
    """
    order = np.argsort(-probability, kind="stable")
    ranked = probability[order]
    predicted, hit = np.cumsum(weight[order]), np.cumsum((weight * road)[order])
    last = int(np.searchsorted(predicted, hit[-1]))
    # Cells of equal probability are on the same side of the threshold.
    last = int(np.searchsorted(-ranked, -ranked[last], side="right")) - 1
    below = ranked[last + 1] if last + 1 < len(ranked) else 0.0
    threshold = float(np.clip((ranked[last] + below) / 2, 0.01, 0.99))
    return threshold, float(hit[last] / (predicted[last] + hit[-1] - hit[last]))


def _fit(train: _Cells, validation: _Cells, rounds: int, options: Options) -> Any:
    from sklearn.ensemble import HistGradientBoostingClassifier

    classifier = HistGradientBoostingClassifier(
        max_iter=rounds,
        learning_rate=options.learning_rate,
        max_leaf_nodes=options.leaves,
        min_samples_leaf=options.leaf_cells,
        l2_regularization=options.smooth,
        max_features=options.share,
        max_bins=BINS,
        # Records validation losses; with this patience it never stops early.
        early_stopping=True,
        n_iter_no_change=rounds,
        random_state=options.seed,
    )
    return classifier.fit(
        train.features,
        train.road,
        # Weights have mean 1, so that the penalty on leaf values does not depend on the tiles.
        sample_weight=train.weight / train.weight.mean(),
        X_val=validation.features,
        y_val=validation.road,
        sample_weight_val=validation.weight / validation.weight.mean(),
    )


def _model(classifier: Any, train: _Cells, threshold: float, facts: dict[str, str | int | float]) -> bytes:
    from sklearn import __version__

    about = About(
        features=train.names,
        photo=train.has_colours,
        cell_m=train.tiles[0][1].cell,
        threshold=threshold,
        scikit_learn=__version__,
        trained=facts,
    )
    return encode(about, classifier)


def _draw(samples: Sequence[Sample], options: Options, name: str) -> _Cells:
    """Draw labelled cells from every tile; reads one tile at a time."""
    use_photo = options.photo
    names: tuple[str, ...] = ()
    values, roads, weights, tile_index, tiles = [], [], [], [], []
    for k in range(len(samples)):
        sample = samples[k]
        data = sample.data
        photo = None if use_photo is False else read_tile_photo(data)
        use_photo = photo is not None if use_photo is None else use_photo
        if use_photo and photo is None:
            raise TaskError(
                f"tile {data.tile_id} has no orthophoto (layer dop): give --dop to `flexroad catalog "
                "rasters`, leave the tile out, or train on heights alone (--set photo=false)",
                layer="dop",
            )
        tile_features = features(data, photo)
        names = tile_features.names
        rng = np.random.default_rng([options.seed, k])
        index, weight = _draw_tile(sample, options.cells, rng)
        values.append(tile_features.values.reshape(len(names), -1)[:, index].T)
        roads.append(sample.road.ravel()[index])
        weights.append(weight)
        tile_index.append(np.full(len(index), k))
        tiles.append((data.tile_id, data.core))
    if not tiles:
        raise TaskError(f"no {name} tiles; use more tiles")
    cells = _Cells(
        names,
        np.concatenate(values),
        np.concatenate(roads),
        np.concatenate(weights),
        np.concatenate(tile_index),
        tuple(tiles),
    )
    if not cells.has_both:
        raise TaskError(f"the {name} tiles have no labels of both road and other ground; use more tiles")
    return cells


def _draw_tile(sample: Sample, most: int, rng: np.random.Generator) -> tuple[NDArray[np.intp], Floats]:
    """Draw labelled cells, at most half of ``most`` of each class; return their indices and weights."""
    index, weight = [], []
    for label in (True, False):
        cells = np.flatnonzero(sample.labelled & (sample.road == label))
        n = min(len(cells), most // 2)
        index.append(np.sort(rng.choice(cells, n, replace=False)))
        weight.append(np.full(n, len(cells) / max(n, 1)))
    return np.concatenate(index), np.concatenate(weight)
