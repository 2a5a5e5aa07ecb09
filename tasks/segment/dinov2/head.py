"""The head on DINOv2 and its file: a linear map and its metadata.

The file is safetensors: the arrays ``weight`` and ``bias``, and `About` as JSON in its metadata. Its source
may be untrusted: sizes are checked before arrays are read, and values before they are used.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from flexroad.catalog.lazy import lazy
from flexroad.catalog.text import access_reason
from flexroad.tasks.errors import TaskError
from flexroad.tasks.options import Options
from flexroad.tasks.segment.dinov2.backbone import PATCH, Backbone, missing_extra
from flexroad.tasks.segment.dinov2.windows import Predict

safetensors = lazy("safetensors")
torch = lazy("torch")

KEY = "flexroad"
"""Key of `About` in the file's metadata."""
REMEDY = "train one: `flexroad train CATALOG --labels mask -o MODEL.safetensors`"

MOST_BYTES = 2**28
"""Largest file (bytes); a head for one class and 40 layers of the largest DINOv2 has 240 KiB."""
Text = Annotated[str, Field(max_length=1000)]
Mean = Annotated[float, Field(ge=0, le=1)]
Deviation = Annotated[float, Field(gt=0, le=1)]


class About(Options):
    """Metadata of a head: the backbone it needs and its provenance."""

    kind: Literal["linear head on DINOv2 patch tokens"] = "linear head on DINOv2 patch tokens"
    version: Literal[1] = 1
    backbone: Text = Field(description="hub name, or folder on the machine where the head was trained")
    model_type: Text = Field(description="dinov2 or dinov2_with_registers")
    registers: int = Field(ge=0, description="number of register tokens")
    weights: Text = Field(description="hash of the backbone's weights, see `Backbone.weights`")
    hidden_size: int = Field(gt=0, le=2**16, description="length of a token")
    layers: int = Field(gt=0, le=40, description="number of last layers whose tokens are concatenated")
    window_px: int = Field(
        ge=28, le=2044, multiple_of=PATCH, description="side of the windows in training (pixels)"
    )
    gsd_m: float = Field(ge=0.02, le=5, description="ground sampling distance in training (m)")
    mean: tuple[Mean, Mean, Mean] = Field(description="subtracted from red, green and blue (0 to 1)")
    std: tuple[Deviation, Deviation, Deviation] = Field(
        description="divisor of red, green and blue after that"
    )
    classes: tuple[Text, ...] = Field(
        max_length=1000, description="class of each weight row; sigmoid(logit) is its probability"
    )
    threshold: float = Field(gt=0, lt=1, description="probability from which a pixel is road")
    trained: dict[str, str | int | float] = Field(description="provenance: data, labels, options, metrics")


@dataclass(frozen=True, eq=False)
class Head:
    """A linear map from patch tokens to one logit per class."""

    weight: NDArray[np.float32]
    """``(classes, layers * hidden_size)``."""
    bias: NDArray[np.float32]
    """``(classes,)``."""
    about: About

    def encode(self) -> bytes:
        """Return the file's content."""
        arrays = {"weight": np.ascontiguousarray(self.weight), "bias": np.ascontiguousarray(self.bias)}
        content: bytes = safetensors.numpy.save(arrays, {KEY: self.about.model_dump_json()})
        return content


def read_head(path: Path) -> Head:
    """Read a head's file."""
    try:
        safe_open, damaged = safetensors.safe_open, safetensors.SafetensorError
    except ImportError as error:
        raise missing_extra(error) from error
    if not path.is_file():
        raise TaskError(f"no head for DINOv2 at {path}; {REMEDY}", str(path))
    try:
        if path.stat().st_size > MOST_BYTES:
            raise ValueError(f"it has more than {MOST_BYTES >> 20} MiB")
        with safe_open(path, framework="numpy") as file:
            about = About.model_validate_json((file.metadata() or {}).get(KEY, "{}"))
            if "road" not in about.classes:
                raise ValueError("road is not one of its classes")
            shape = len(about.classes), about.layers * about.hidden_size
            return Head(_array(file, "weight", shape), _array(file, "bias", shape[:1]), about)
    except (damaged, ValueError, OSError) as error:
        if why := access_reason(error):
            raise TaskError(f"{path} {why}", str(path)) from error
        raise TaskError(
            f"{path} is not a head for DINOv2, or is damaged ({_reason(error)}); {REMEDY}", str(path)
        ) from error


def _array(file: Any, name: str, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return an array of a file, checked."""
    part = file.get_slice(name)
    found, kind = tuple(part.get_shape()), part.get_dtype()
    if found != shape or kind != "F32":
        raise ValueError(f"its {name} is {kind} of shape {found}, not F32 of {shape}")
    values: NDArray[np.float32] = file.get_tensor(name)
    if not np.isfinite(values).all():
        raise ValueError(f"its {name} has values that are not numbers")
    return values


def _reason(error: Exception) -> str:
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        return f"its metadata, {'.'.join(map(str, first['loc']))}: {first['msg']}"
    return " ".join(str(error).split())[:200]


def check(head: Head, backbone: Backbone) -> None:
    """Check that a head was trained on this backbone."""
    about = head.about
    expected = {
        "model_type": about.model_type,
        "registers": about.registers,
        "hidden_size": about.hidden_size,
    }
    actual = {name: getattr(backbone, name) for name in expected}
    if expected != actual:
        difference = ", ".join(
            f"{name} {expected[name]} not {actual[name]}"
            for name in expected
            if expected[name] != actual[name]
        )
    elif about.layers > backbone.layers:
        difference = f"it uses {about.layers} layers, the backbone has {backbone.layers}"
    elif about.weights != backbone.weights:
        difference = f"weights {about.weights}, not {backbone.weights}"
    else:
        return
    raise TaskError(
        f"the head was trained on {about.backbone}, not on {backbone.name} ({difference}); "
        "set segment.backbone to the folder of that model, or train a head on this one"
    )


def predictor(head: Head, backbone: Backbone) -> Predict:
    """Return a function: windows -> probability of road for each of their pixels.

    The logits of the patches are interpolated to the pixels (bilinear), as in DINOv2's segmentation heads.
    """
    row = head.about.classes.index("road")
    weight = torch.from_numpy(head.weight[row]).to(backbone.device)
    bias = float(head.bias[row])

    def predict(windows: NDArray[np.float32]) -> NDArray[np.float32]:
        with torch.inference_mode():
            logits = backbone.tokens(windows, head.about.layers) @ weight + bias
            fine = torch.nn.functional.interpolate(
                logits[:, None], size=windows.shape[-2:], mode="bilinear", align_corners=False
            )
            probability: Any = fine[:, 0].sigmoid().cpu().numpy()
        return np.asarray(probability, np.float32)

    return predict
