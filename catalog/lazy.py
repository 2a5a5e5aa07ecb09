"""Libraries that are imported when they are first used, so that short commands start fast.

>>> rasterio = lazy("rasterio")
>>> rasterio.features.rasterize
<function rasterize at ...>

Python's own ``LazyLoader``, which the library ``lazy_loader`` uses, puts an unfinished module into
``sys.modules``. Before Python 3.11.8 two threads that use it at once fail. It also imports the parents of a
submodule at once.
"""

from __future__ import annotations

import gc
import importlib
import sys
from types import ModuleType
from typing import Any


class LazyModule:
    """A module that is imported when one of its names is first used.

    A name that the module does not have is searched among its submodules. Names are set and deleted in the
    module itself.
    """

    __slots__ = ("_name",)
    _name: str

    def __init__(self, name: str) -> None:
        object.__setattr__(self, "_name", name)

    def __getattr__(self, name: str) -> Any:
        # Tools that inspect a file read these names; they must not cause an import.
        if name.startswith("__") and name != "__version__":
            raise AttributeError(f"{name!r} does not import module {self._name!r}")
        module = _imported(self._name)
        try:
            return getattr(module, name)
        except AttributeError as error:
            submodule = f"{module.__name__}.{name}"
            try:
                return _imported(submodule)
            except ModuleNotFoundError as missing:
                if missing.name != submodule:
                    raise
                raise error from None

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(importlib.import_module(self._name), name, value)

    def __delattr__(self, name: str) -> None:
        delattr(importlib.import_module(self._name), name)

    def __reduce__(self) -> tuple[type[LazyModule], tuple[str]]:
        return LazyModule, (self._name,)


def _imported(name: str) -> ModuleType:
    """Import a module without garbage collections: nearly all of its objects stay in use."""
    if name in sys.modules or not gc.isenabled():
        return importlib.import_module(name)
    gc.disable()
    try:
        return importlib.import_module(name)
    finally:
        gc.enable()


def lazy(name: str) -> Any:
    """Return a library that is imported when one of its names is first used."""
    return LazyModule(name)
