"""What the option models of all stages share."""

from pydantic import BaseModel, ConfigDict


class Options(BaseModel):
    """Base of the stages' option models: frozen; unknown keys, NaN and infinity refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
