"""The model of `pixels` and its file: a gradient-boosted classifier, and everything one must know to use it.

The file is skops': a zip of arrays and JSON. Unlike a pickle it can be taken from others, for what is not
on the list of known types is refused before anything of it is built.
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
"""What skops does not know of itself: scikit-learn's holder of a tree's array of nodes."""
HOW = "train one: `flexroad train CATALOG --method pixels --labels mask -o MODEL.skops`"


class About(Options):
    """What a model needs and where it comes from."""

    kind: Literal["road by features of cells"] = "road by features of cells"
    version: Literal[1] = 1
    features: tuple[str, ...] = Field(description="names of the features, in the classifier's order")
    photo: bool = Field(description="whether some of them are of an orthophoto")
    cell_m: float = Field(gt=0, description="cell size of the tiles it learnt from (m)")
    threshold: float = Field(gt=0, lt=1, description="probability from which a cell is road")
    scikit_learn: str = Field(description="version that made the classifier")
    trained: dict[str, str | int | float] = Field(description="provenance: tiles, options, figures")


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

    def probability(self, features: Features, where: Bools) -> NDArray[np.float32]:
        """Return the probability of road, ``(H, W)``; 0 but for the cells asked for.

        Raises
        ------
        TaskError
            If the model needs features that these are not.
        """
        missing = [name for name in self.about.features if name not in features.names]
        if missing:
            raise TaskError(f"the model needs {missing[0]!r}, which this version does not compute; {HOW}")
        order = [features.names.index(name) for name in self.about.features]
        found = np.zeros(where.shape, np.float32)
        if where.any():
            found[where] = self.classifier.predict_proba(features.values[order][:, where].T)[:, 1]
        return found


def read_model(path: Path) -> Model:
    """Read a model's file, once per process.

    Raises
    ------
    TaskError
        If it is not there, damaged, or something else.
    """
    try:
        stat = path.stat()
    except OSError as error:
        raise TaskError(f"no model of pixels at {path}; {HOW}", str(path)) from error
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
        # A classifier of another version can be built, and fail when it is asked.
        classifier.predict_proba(np.zeros((1, len(about.features)), np.float32))
    # Strange bytes fail in as many ways as there are lines in zip, JSON, numpy and scikit-learn.
    except Exception as error:
        why = str(error).partition("\n")[0] or type(error).__name__
        if about and about.scikit_learn != __version__:
            why = f"made with scikit-learn {about.scikit_learn}, here is {__version__}: {why}"
        raise TaskError(f"{path} is no model of pixels, or damaged ({why}); {HOW}", str(path)) from error
    return Model(classifier, about)
