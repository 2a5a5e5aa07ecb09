"""The model of `pixels` and its file: a gradient-boosted classifier and its metadata.

The file format is skops: a zip of arrays and JSON. Unlike a pickle, a file from others is safe to load: types
that are not on a list of trusted ones are rejected before any object is created.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flexroad.tasks.errors import TaskError
from flexroad.tasks.options import Options
from flexroad.tasks.segment.pixels.features import Features
from flexroad.tasks.types import Bools

TRUSTED = ("sklearn.ensemble._hist_gradient_boosting.predictor.TreePredictor",)
"""Type that skops does not trust by default: scikit-learn's container of a tree's nodes."""
REMEDY = "train one: `flexroad train CATALOG --method pixels --labels mask -o MODEL.skops`"


class About(Options):
    """Metadata of a model: the features it needs and its provenance."""

    kind: Literal["road by features of cells"] = "road by features of cells"
    version: Literal[1] = 1
    features: tuple[str, ...] = Field(description="names of the features, in the classifier's order")
    photo: bool = Field(description="whether some features come from an orthophoto")
    cell_m: float = Field(gt=0, description="cell size of the training tiles (m)")
    threshold: float = Field(gt=0, lt=1, description="probability from which a cell is road")
    scikit_learn: str = Field(description="version of scikit-learn that trained it")
    trained: dict[str, str | int | float] = Field(description="provenance: tiles, options, metrics")


def require() -> None:
    """Check that the libraries of the extra ``train`` are installed.

    Raises
    ------
    TaskError
        If one is missing.
    """
    for package in ("sklearn", "skops"):
        if importlib.util.find_spec(package) is None:
            name = {"sklearn": "scikit-learn"}.get(package, package)
            raise TaskError(f"segment: pixels needs {name}: pip install 'flexroad[train]'")


@dataclass(frozen=True, eq=False)
class Model:
    """A classifier of cells."""

    classifier: Any
    """scikit-learn's `HistGradientBoostingClassifier`."""
    about: About

    def encode(self) -> bytes:
        """Return the file's content."""
        from skops.io import dumps

        about = self.about.model_dump_json()
        content: bytes = dumps({"about": about, "classifier": self.classifier}, compression=8)
        return content

    def probability(self, features: Features, cells: Bools) -> NDArray[np.float32]:
        """Return the probability of road in the given cells, ``(H, W)``; 0 elsewhere.

        Raises
        ------
        TaskError
            If a feature that the model needs is missing.
        """
        missing = [name for name in self.about.features if name not in features.names]
        if missing:
            raise TaskError(f"the model needs {missing[0]!r}, which this version does not compute; {REMEDY}")
        order = [features.names.index(name) for name in self.about.features]
        result = np.zeros(cells.shape, np.float32)
        if cells.any():
            result[cells] = self.classifier.predict_proba(features.values[order][:, cells].T)[:, 1]
        return result


def read_model(path: Path) -> Model:
    """Read a model's file, once per process.

    Raises
    ------
    TaskError
        If the file does not exist, is damaged or is not a model.
    """
    try:
        stat = path.stat()
    except OSError as error:
        raise TaskError(f"no model for segment: pixels at {path}; {REMEDY}", str(path)) from error
    return _read(path, stat.st_size, stat.st_mtime_ns)


@lru_cache(maxsize=4)
def _read(path: Path, size: int, mtime_ns: int) -> Model:
    require()
    from sklearn import __version__
    from sklearn.ensemble import HistGradientBoostingClassifier
    from skops.io import loads

    about = None
    try:
        content = loads(path.read_bytes(), trusted=list(TRUSTED))
        about = About.model_validate_json(content["about"])
        classifier = content["classifier"]
        if not isinstance(classifier, HistGradientBoostingClassifier):
            raise TypeError(f"its classifier is a {type(classifier).__name__}")
        # A classifier of another scikit-learn version may load, but fail to predict.
        classifier.predict_proba(np.zeros((1, len(about.features)), np.float32))
    except Exception as error:  # zip, JSON, numpy and scikit-learn raise many types for damaged files
        reason = str(error).partition("\n")[0] or type(error).__name__
        if about and about.scikit_learn != __version__:
            reason = f"made with scikit-learn {about.scikit_learn}, installed is {__version__}: {reason}"
        raise TaskError(
            f"{path} is not a model for segment: pixels, or is damaged ({reason}); {REMEDY}", str(path)
        ) from error
    return Model(classifier, about)
