"""Smooth, light, georeferenced 3D road surfaces from aerial geodata.

>>> import flexroad
>>> scene = flexroad.example(size_m=60)
>>> surface = flexroad.fit(scene.dsm, scene.dtm, scene.road_mask)
>>> float(surface.height(500210.0, 5600030.0).round(1))
152.4

The names below are imported on first use: ``import flexroad`` alone loads no numerical library.
"""

import importlib
import importlib.metadata
import sys
import warnings
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flexroad.catalog.errors import CatalogError
    from flexroad.pipeline.errors import ConfigError
    from flexroad.pipeline.run.events import Observer
    from flexroad.tasks.errors import TaskError
    from flexroad.tools.results.process import catalog_from, run
    from flexroad.tools.results.run import RunView, open_run
    from flexroad.tools.results.surface import Surface, fit, open_surface
    from flexroad.tools.synthetic.example import example

    __version__: str

__all__ = [
    "CatalogError",
    "ConfigError",
    "Observer",
    "RunView",
    "Surface",
    "TaskError",
    "__version__",
    "catalog_from",
    "example",
    "fit",
    "open_run",
    "open_surface",
    "run",
]

_HOME = {
    "CatalogError": "catalog.errors",
    "ConfigError": "pipeline.errors",
    "Observer": "pipeline.run.events",
    "RunView": "tools.results.run",
    "Surface": "tools.results.surface",
    "TaskError": "tasks.errors",
    "catalog_from": "tools.results.process",
    "example": "tools.synthetic.example",
    "fit": "tools.results.surface",
    "open_run": "tools.results.run",
    "open_surface": "tools.results.surface",
    "run": "tools.results.process",
}
"""The module of each public name, below this package."""


def __getattr__(name: str) -> Any:
    if name == "__version__":
        value: Any = importlib.metadata.version("flexroad")
    elif name in _HOME:
        value = getattr(importlib.import_module(f"flexroad.{_HOME[name]}"), name)
        if ignored := getattr(sys.modules.get("flexroad.pipeline"), "IGNORED", ""):
            warnings.warn(ignored, stacklevel=2)
    else:
        raise AttributeError(f"module 'flexroad' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
