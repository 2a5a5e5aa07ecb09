"""Train a segmenter on some of a catalog's tiles, and judge it on others that lie apart.

What is judged is the segmenter itself with the model as it will be used, but for the cleanup: the report
shows what was learnt, not what tidying makes of it.
"""

from __future__ import annotations

import importlib
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from flexroad.catalog import Bounds, Catalog, Grid, Tile
from flexroad.pipeline.config.methods import methods
from flexroad.pipeline.config.models import Config
from flexroad.pipeline.errors import ConfigError
from flexroad.pipeline.training.spatial_split import Block, Split, inside, split, split_tile
from flexroad.tasks import load
from flexroad.tasks.errors import TaskError
from flexroad.tasks.io.orthophoto import read_photo
from flexroad.tasks.options import Options
from flexroad.tasks.roads import rasterise
from flexroad.tasks.roads.extent import beyond_extent
from flexroad.tasks.roads.mask_cleanup import NOTHING, within
from flexroad.tasks.roads.mask_metrics import Quality, judge, together
from flexroad.tasks.segment.training_types import Round, Sample, Trained
from flexroad.tasks.types import Bools, Floats, RoadMask, TileData

Labels = Literal["mask", "vector"]
Say = Callable[[str], None]


@dataclass(frozen=True)
class TrainOptions:
    """How to train."""

    method: str
    labels: Labels
    validation: float = 0.3
    """Share of the tiles that are for judging."""
    gap_m: float = 50.0
    """Cells nearer than this to those tiles are not learnt from."""
    ignore_m: float = 1.0
    """Cells nearer than this to an edge of the labels are not learnt from: labels are never exact."""
    seed: int = 0
    settings: Mapping[str, Any] | None = None
    """Options of the method's training, by name."""


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What the model made of one piece of the validation side."""

    piece: Block
    quality: Quality
    inner: Quality
    """The same without the band along the labels' edges."""
    found: NDArray[np.uint8]
    """The mask of the tile's core, eight cells a byte."""
    note: str = ""


@dataclass(frozen=True, eq=False)
class Preview:
    """What there is to look at of one tile."""

    grid: Grid
    ground: Floats | NDArray[np.uint8]
    """The photo, ``(3, h, w)``, or heights where there is none, ``(H, W)``, m."""
    truth: Bools
    found: Bools


@dataclass(frozen=True)
class LabelledTiles:
    """Tiles with their labels, read anew whenever they are looked at: memory does not grow with the land."""

    asked: TrainOptions
    load: load.Options
    vectors: rasterise.Options

    def labelled(self, tile: Tile) -> tuple[TileData, Bools] | None:
        """Return a tile and its labels, or None if it has none.

        Raises
        ------
        TaskError
            If it cannot be read.
        """
        data = load.load(tile, self.load)
        if self.asked.labels == "vector":
            return None if data.roads is None else (data, rasterise.rasterise_roads(data, self.vectors))
        road = data.road_mask if data.reference_road is None else data.reference_road
        return None if road is None else (data, road)

    def sound(self, tile: Tile) -> tuple[TileData, Bools]:
        """Return a tile that had labels before, and them.

        Raises
        ------
        TaskError
            If it has none any more, or cannot be read.
        """
        found = self.labelled(tile)
        if found is None:
            raise TaskError(f"tile {tile.id} has lost its labels since training began; start again")
        return found

    def sure(self, data: TileData, road: Bools) -> Bools:
        """Return the cells within the survey and outside the band along label edges, ``(H, W)``."""
        cell, reach = data.grid.cell, self.asked.ignore_m
        band = within(road, cell, reach) & within(~road, cell, reach)
        return ~beyond_extent(data) & ~band

    def pieces(self, tile: Tile, parts: Sequence[Bounds]) -> list[Block]:
        """Return the parts of a tile with what is labelled in them; none if it has no labels."""
        found = self.labelled(tile)
        if found is None:
            return []
        data, road = found
        counts = self.sure(data, road)
        where = [counts & inside(data.grid, bounds) for bounds in parts]
        return [
            Block(tile, bounds, int((cells & road).sum()), int((cells & ~road).sum()))
            for bounds, cells in zip(parts, where, strict=True)
            if cells.any()
        ]


@dataclass(frozen=True, eq=False)
class Outcome:
    """A trained model and how good it is."""

    asked: TrainOptions
    ground: LabelledTiles
    trained: Trained
    split: Split
    judged: tuple[Evaluation, ...]
    notes: tuple[str, ...]

    def look(self, one: Evaluation) -> Preview:
        """Return what there is to look at of one tile; it is read anew."""
        data, truth = self.ground.sound(one.piece.tile)
        window = data.grid.window(data.core)
        found = np.unpackbits(one.found, count=data.core.width * data.core.height).astype(bool)
        ground = data.dsm[window] if data.dop is None else read_photo(data.dop, data.core).colour
        return Preview(data.core, ground, truth[window], found.reshape(data.core.shape))

    @property
    def quality(self) -> Quality:
        """Over all pieces."""
        return together(one.quality for one in self.judged)

    @property
    def inner(self) -> Quality:
        """The same without the band along the labels' edges."""
        return together(one.inner for one in self.judged)


@dataclass(frozen=True)
class Samples(Sequence[Sample]):
    """The tiles of one side as a method learns from them, each read when it is asked for."""

    ground: LabelledTiles
    split: Split
    part: Literal["train", "validate"]

    @cached_property
    def _pieces(self) -> tuple[Block, ...]:
        return self.split.train if self.part == "train" else self.split.validate

    def __len__(self) -> int:
        return len(self._pieces)

    def __getitem__(self, index: Any) -> Any:
        piece = self._pieces[index]
        data, road = self.ground.sound(piece.tile)
        apart = self.split.learnt if self.part == "train" else inside
        return Sample(data, road, self.ground.sure(data, road) & apart(data.grid, piece.bounds))


def train(catalog: Catalog, config: Config, asked: TrainOptions, say: Say) -> Outcome:
    """Train a method on a catalog and judge what it learnt.

    Parameters
    ----------
    catalog : Catalog
    config : Config
        Its first exported variant's options of `load` are used and, of the same method, those of `segment`.
    asked : Asked
    say : callable
        Told of progress, line by line.

    Raises
    ------
    ConfigError
        If the method or a setting of it is unknown, or the labels do not serve.
    TaskError
        If learning fails.
    """
    method = _method(asked)
    settings = _settings(method, asked)
    ground = LabelledTiles(asked, _chain(config)["load"], _vector_options(config))
    notes: list[str] = []
    sides = _split(list(_labelled(catalog, ground, notes)), ground)
    say(f"{len(sides.train)} tiles to learn from, {len(sides.validate)} to judge by")
    sides_read = [Samples(ground, sides, part) for part in ("train", "validate")]

    def progress(done: int, of: int, last: Round) -> None:
        say(f"round {done} of {of}: loss {last.train_loss:.4f}, validation {last.validation_loss:.4f}")

    trained: Trained = method.train(*sides_read, settings, progress)
    segment = methods("segment")[asked.method]
    with tempfile.TemporaryDirectory(prefix="flexroad-") as folder:
        model = Path(folder, f"model{trained.suffix}")
        model.write_bytes(trained.model)
        options = segment_options(config, asked.method, model)
        judged = tuple(
            _judge(piece, ground, lambda data: segment.segment(data, options)) for piece in sides.validate
        )
    notes += [f"{one.piece.tile.id}: {one.note}" for one in judged if one.note]
    return Outcome(asked, ground, trained, sides, judged, tuple(notes))


def segment_options(config: Config, method: str, model: Path) -> Options:
    """Return how a model is applied to be judged: as configured, without cleanup."""
    configured = _chain(config)["segment"]
    module = methods("segment")[method]
    given = configured.model_dump() if isinstance(configured, module.Options) else {"method": method}
    options: Options = module.Options(**given | {"model": model, "cleanup": NOTHING})
    return options


def _judge(piece: Block, ground: LabelledTiles, segment: Callable[[TileData], RoadMask]) -> Evaluation:
    data, road = ground.sound(piece.tile)
    here = inside(data.grid, piece.bounds) & ~beyond_extent(data)
    note = ""
    try:
        mask = segment(data)
        cells, probability = mask.mask, mask.probability
    except TaskError as error:
        # A tile whose roads are all missed counts as that.
        cells, probability, note = np.zeros_like(road), np.zeros(road.shape, np.float32), str(error)
    whole, inner = (
        judge(cells, probability, road, known, data.grid) for known in (here, here & ground.sure(data, road))
    )
    core = cells[data.grid.window(data.core)]
    return Evaluation(piece, whole, inner, np.packbits(core), note)


def _labelled(catalog: Catalog, ground: LabelledTiles, notes: list[str]) -> Iterator[Block]:
    """Yield the tiles that have labels, a single one in two parts; note those that cannot be read."""
    single = len(catalog.tiles) == 1
    for tile in catalog.tiles:
        if ground.asked.method == "dinov2" and tile.layer("dop") is None:
            continue
        bounds = tile.grid.bounds
        try:
            yield from ground.pieces(
                tile, split_tile(bounds, ground.asked.validation) if single else [bounds]
            )
        except TaskError as error:
            notes.append(f"{tile.id} is left out: {error}")


def _split(pieces: Sequence[Block], ground: LabelledTiles) -> Split:
    asked = ground.asked
    _check_labels(pieces, asked)
    if len(pieces) == 1:
        raise ConfigError(
            f"only tile {pieces[0].tile.id} has labels: there is none to judge by; label another one, or "
            "make a catalog of this one alone, which is then parted in two"
        )
    sides = split(pieces, asked.validation, asked.gap_m, asked.seed)
    train = tuple(piece for piece in sides.train if sides.learnt(piece.tile.grid, piece.bounds).any())
    if not any(piece.road for piece in train):
        raise ConfigError(
            f"no road is left to learn from {asked.gap_m:g} m and more from the tiles to judge by; "
            "lower --gap-m, or label more tiles"
        )
    return Split(train, sides.validate, sides.gap_m)


def _check_labels(pieces: Sequence[Block], asked: TrainOptions) -> None:
    if not pieces:
        lacking = {
            "vector": "vectors of roads: give --roads to `flexroad catalog rasters`",
            "mask": "mask of roads: give --reference-road or --road-mask to `flexroad catalog rasters`",
        }[asked.labels]
        photo = " and an orthophoto (--dop)" if asked.method == "dinov2" else ""
        raise ConfigError(f"no readable tile has a {lacking}{photo}".replace("a vectors", "vectors"))
    road, ground = (sum(counts) for counts in zip(*((p.road, p.ground) for p in pieces), strict=True))
    if not road or not ground:
        raise ConfigError(
            f"the labels of all {len(pieces)} tiles are {'road' if road else 'no road'}: there is nothing to "
            "tell apart; check --road-value of `flexroad catalog rasters`, or the vectors' segment.where"
        )


def _method(asked: TrainOptions) -> Any:
    home = Path(importlib.import_module("flexroad.tasks.segment").__path__[0])
    known = sorted(path.parent.name for path in home.glob("*/train.py"))
    if asked.method not in known:
        raise ConfigError(f"--method {asked.method}: there are {', '.join(known)}")
    return importlib.import_module(f"flexroad.tasks.segment.{asked.method}.train")


def _settings(method: Any, asked: TrainOptions) -> Options:
    given = dict(asked.settings or {})
    if "seed" in method.Options.model_fields:
        given.setdefault("seed", asked.seed)
    try:
        options: Options = method.Options(**given)
    except ValidationError as error:
        fault = error.errors()[0]
        name = ".".join(str(part) for part in fault["loc"])
        raise ConfigError(
            f"--set {name}: {fault['msg'].lower()}, not {fault['input']!r}; "
            f"{asked.method} has {', '.join(method.Options.model_fields)}"
        ) from error
    return options


def _vector_options(config: Config) -> rasterise.Options:
    """Return how wide lines are: as the configuration's segmenter by vectors has it, else by default."""
    segment = _chain(config)["segment"]
    return segment if isinstance(segment, rasterise.Options) else rasterise.DEFAULTS


def _chain(config: Config) -> dict[str, Any]:
    return config.chains[config.export.variants[0]]
