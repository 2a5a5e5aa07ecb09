"""The head on DINOv2 and its file: a linear map and its metadata.

The file is safetensors: the arrays ``weight`` and ``bias``, and `About` as JSON in its metadata.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from flexroad.tasks.errors import TaskError
from flexroad.tasks.options import Options
from flexroad.tasks.segment.dinov2.backbone import Backbone, missing_extra
from flexroad.tasks.segment.dinov2.windows import Predict

KEY = "flexroad"
"""Key of `About` in the file's metadata."""
REMEDY = "train one: `flexroad train CATALOG --method dinov2 --labels mask -o MODEL.safetensors`"


class About(Options):
    """Metadata of a head: the backbone it needs and its provenance."""

    kind: Literal["linear head on DINOv2 patch tokens"] = "linear head on DINOv2 patch tokens"
    version: Literal[1] = 1
    backbone: str = Field(description="hub name, or folder on the machine where the head was trained")
    model_type: str = Field(description="dinov2 or dinov2_with_registers")
    registers: int = Field(ge=0, description="number of register tokens")
    weights: str = Field(description="hash of the backbone's weights, see `Backbone.weights`")
    hidden_size: int = Field(gt=0, description="length of a token")
    layers: int = Field(gt=0, description="number of last layers whose tokens are concatenated")
    window_px: int = Field(gt=0, description="side of the windows in training (pixels)")
    gsd_m: float = Field(gt=0, description="ground sampling distance in training (m)")
    mean: tuple[float, float, float] = Field(description="subtracted from red, green and blue (0 to 1)")
    std: tuple[float, float, float] = Field(description="divisor of red, green and blue after that")
    classes: tuple[str, ...] = Field(
        description="class of each weight row; sigmoid(logit) is its probability"
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
        from safetensors.numpy import save

        arrays = {"weight": np.ascontiguousarray(self.weight), "bias": np.ascontiguousarray(self.bias)}
        content: bytes = save(arrays, {KEY: self.about.model_dump_json()})
        return content


def read_head(path: Path) -> Head:
    """Read a head's file.

    Raises
    ------
    TaskError
        If the file does not exist, is damaged or is not a head, or safetensors is not installed.
    """
    try:
        from safetensors import SafetensorError, safe_open
    except ImportError as error:
        raise missing_extra(error) from error
    if not path.is_file():
        raise TaskError(f"no head for DINOv2 at {path}; {REMEDY}", str(path))
    try:
        with safe_open(path, framework="numpy") as file:
            about = About.model_validate_json((file.metadata() or {}).get(KEY, "{}"))
            head = Head(file.get_tensor("weight"), file.get_tensor("bias"), about)
    except (SafetensorError, ValidationError, OSError) as error:
        cause = error.errors()[0]["loc"] if isinstance(error, ValidationError) else error
        reason = f"its metadata lack {'.'.join(map(str, cause))}" if isinstance(cause, tuple) else cause
        raise TaskError(
            f"{path} is not a head for DINOv2, or is damaged ({reason}); {REMEDY}", str(path)
        ) from error
    if "road" not in about.classes or head.weight.shape != (
        len(about.classes),
        about.layers * about.hidden_size,
    ):
        raise TaskError(
            f"{path}: a weight of shape {head.weight.shape} does not fit classes {about.classes} and "
            f"{about.layers} layers of {about.hidden_size}; {REMEDY}",
            str(path),
        )
    return head


def check(head: Head, backbone: Backbone) -> None:
    """Check that a head was trained on this backbone.

    Raises
    ------
    TaskError
        If model type, size, layers or weights differ.
    """
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


def predictor(head: Head, backbone: Backbone, class_name: str = "road") -> Predict:
    """Return a function: windows -> probability of a class for each of their pixels.

    The logits of the patches are interpolated to the pixels (bilinear), as in DINOv2's segmentation heads.
    """
    import torch

    row = head.about.classes.index(class_name)
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
