"""The stages of the paper: their names, their inputs and the file of each.

::

    load      tasks/load.py               DSM, DTM, masks and reference of a tile, on one lattice
    segment   tasks/segment/METHOD.py     the road mask M^r (step B)
    ecsrc     tasks/filter/METHOD.py      the filtered mask M^{r+} (step B, Algorithm 1)
    fit       tasks/fit/METHOD.py         the surface S (step C)
    sample    tasks/sample.py             the mesh (dynamic surface sampling)
    evaluate  tasks/metrics/evaluate.py   error, smoothness and size of the mesh
    assess    tasks/quality/assess.py     flags and an error estimate without ground truth; not the paper's

`pipeline.config.methods` imports the files.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from flexroad.tasks.options import Options, stage_module

STAGES: dict[str, tuple[str, ...]] = {
    "load": (),
    "segment": ("load",),
    "ecsrc": ("load", "segment"),
    "fit": ("load", "ecsrc"),
    "sample": ("fit", "segment", "ecsrc"),
    "evaluate": ("sample", "load", "segment", "fit"),
    "assess": ("load", "segment", "ecsrc", "fit"),
}
"""The stages of the paper, in its order, and the stages whose results their functions take, in that order."""
STAGE_NAMES = tuple(STAGES)


def stage_version(stage: str, options: Options) -> tuple[str, int]:
    """Return the name of a stage with its method, such as ``fit.nurbs``, and its `VERSION`."""
    method = options.model_dump().get("method")
    return f"{stage}.{method}" if method else stage, stage_module(options).VERSION


def stage_head(stage: str, options: Options) -> list[Any]:
    """Return stage, `VERSION` and options as they enter fingerprints."""
    module = stage_module(options)
    version = [module.VERSION, module.LEVELS_VERSION] if getattr(options, "levels", False) else module.VERSION
    return [stage, version, options.model_dump(mode="json")]


def model_files(options: Options) -> tuple[Path, ...]:
    """Return the files named by the options, such as a model: the result of their module's `files`."""
    files: Callable[[Options], tuple[Path, ...]] = getattr(stage_module(options), "files", lambda _: ())
    return files(options)
