"""The model of `pixels` and its file: gradient-boosted trees and their metadata.

The file format is skops: a zip of arrays and JSON. Only numbers and the text of the metadata are read, see
`trees`.
"""

from __future__ import annotations

import importlib.util
import stat
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flexroad.catalog.text import one_line
from flexroad.tasks.errors import TaskError
from flexroad.tasks.options import Options
from flexroad.tasks.segment.pixels.features import Features
from flexroad.tasks.segment.pixels.trees import Trees, assemble, read_archive
from flexroad.tasks.types import Bools

REMEDY = "train one: `flexroad train CATALOG --method pixels --labels mask -o MODEL.skops`"
Name = Annotated[str, Field(max_length=100)]


class About(Options):
    """Metadata of a model: the features it needs and its provenance."""

    kind: Literal["road by features of cells"] = "road by features of cells"
    version: Literal[1] = 1
    features: tuple[Name, ...] = Field(
        max_length=1000, description="names of the features, in the classifier's order"
    )
    photo: bool = Field(description="whether some features come from an orthophoto")
    cell_m: float = Field(gt=0, description="cell size of the training tiles (m)")
    threshold: float = Field(gt=0, lt=1, description="probability from which a cell is road")
    scikit_learn: Name = Field(description="version of scikit-learn that trained it")
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


def encode(about: About, classifier: Any) -> bytes:
    """Return the content of a model's file.

    Parameters
    ----------
    about : About
        Metadata.
    classifier : HistGradientBoostingClassifier
        Classifier of road and other ground, without categories.
    """
    from skops.io import dumps

    content: bytes = dumps({"about": about.model_dump_json(), "classifier": classifier}, compression=8)
    return content


@dataclass(frozen=True, eq=False)
class Model:
    """A classifier of cells."""

    trees: Trees
    about: About

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
            result[cells] = self.trees.probability(features.values[order][:, cells].T)
        return result


def read_model(path: Path) -> Model:
    """Read a model's file, once per process.

    Raises
    ------
    TaskError
        If the file does not exist, is damaged or is not a model.
    """
    try:
        found = path.stat()
    except OSError as error:
        raise TaskError(f"no model for segment: pixels at {path}; {REMEDY}", str(path)) from error
    if not stat.S_ISREG(found.st_mode):
        raise TaskError(f"{path} is not a file; {REMEDY}", str(path))
    return _read(path, found.st_size, found.st_mtime_ns)


@lru_cache(maxsize=4)
def _read(path: Path, size: int, mtime_ns: int) -> Model:
    trained = ""
    try:
        with path.open("rb") as file:
            text, nodes, baseline = read_archive(file)
        about = About.model_validate_json(text)
        trained = f"made with scikit-learn {about.scikit_learn}: "
        return Model(assemble(nodes, baseline, len(about.features)), about)
    except Exception as error:  # zip, JSON, NumPy and pydantic raise many types for damaged files
        reason = f"{trained}{one_line(error)}"
        raise TaskError(
            f"{path} is not a model for segment: pixels, or is damaged ({reason}); {REMEDY}",
            str(path),
        ) from error
