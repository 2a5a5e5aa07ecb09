"""Base class of the stages' option models."""

from pydantic import BaseModel, ConfigDict


class Options(BaseModel):
    """Base of the stages' option models: frozen; unknown keys, NaN and infinity raise an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
