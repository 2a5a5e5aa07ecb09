"""Base class of the stages' option models, and the stage that belongs to some options."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

from pydantic import BaseModel, ConfigDict


class Options(BaseModel):
    """Base of the stages' option models: frozen; unknown keys, NaN and infinity raise an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def stage_module(options: Options) -> ModuleType:
    """Return the module that computes the stage: it defines the options' class and `VERSION`."""
    return sys.modules[type(options).__module__]


def stage_function(stage: str, options: Options) -> Callable[..., Any]:
    """Return the function that computes a stage: the function named ``stage`` in the options' module."""
    function: Callable[..., Any] = getattr(stage_module(options), stage)
    return function
