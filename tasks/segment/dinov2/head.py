"""The head over DINOv2 and its file: one linear map, and everything one must know to use it.

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
"""Under which the file's metadata holds `About`."""
HOW = "train one: `flexroad train CATALOG --method dinov2 --labels mask -o MODEL.safetensors`"


class About(Options):
    """What a head fits and where it comes from."""

    kind: Literal["linear head on DINOv2 patch tokens"] = "linear head on DINOv2 patch tokens"
    version: Literal[1] = 1
    backbone: str = Field(description="hub name, or folder on the machine where the head was trained")
    model_type: str = Field(description="dinov2 or dinov2_with_registers")
    registers: int = Field(ge=0, description="number of register tokens")
    weights: str = Field(description="which weights the backbone had, by `Backbone.weights`")
    hidden_size: int = Field(gt=0, description="length of a token")
    layers: int = Field(gt=0, description="tokens of the last so many layers, one after the other")
    window_px: int = Field(gt=0, description="side of the windows in training (pixels)")
    gsd_m: float = Field(gt=0, description="ground sampling distance in training (m)")
    mean: tuple[float, float, float] = Field(description="subtracted from red, green and blue of 0 to 1")
    std: tuple[float, float, float] = Field(description="then divided by")
    classes: tuple[str, ...] = Field(description="one per row of the weight; the sigmoid is its probability")
    threshold: float = Field(gt=0, lt=1, description="probability from which a pixel is road")
    trained: dict[str, str | int | float] = Field(description="provenance: data, labels, options, figures")


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
        If it is not there, damaged, or something else; or if safetensors is not installed.
    """
    try:
        from safetensors import SafetensorError, safe_open
    except ImportError as error:
        raise missing_extra(error) from error
    if not path.is_file():
        raise TaskError(f"no head for DINOv2 at {path}; {HOW}", str(path))
    try:
        with safe_open(path, framework="numpy") as file:
            about = About.model_validate_json((file.metadata() or {}).get(KEY, "{}"))
            head = Head(file.get_tensor("weight"), file.get_tensor("bias"), about)
    except (SafetensorError, ValidationError, OSError) as error:
        why = error.errors()[0]["loc"] if isinstance(error, ValidationError) else error
        what = f"its metadata lack {'.'.join(map(str, why))}" if isinstance(why, tuple) else why
        raise TaskError(f"{path} is no head for DINOv2, or damaged ({what}); {HOW}", str(path)) from error
    if "road" not in about.classes or head.weight.shape != (
        len(about.classes),
        about.layers * about.hidden_size,
    ):
        raise TaskError(
            f"{path}: a weight of shape {head.weight.shape} does not fit classes {about.classes} and "
            f"{about.layers} layers of {about.hidden_size}; {HOW}",
            str(path),
        )
    return head


def check(head: Head, backbone: Backbone) -> None:
    """Make sure that a head was trained on this backbone.

    Raises
    ------
    TaskError
        If kind, size, layers or weights differ.
    """
    about = head.about
    asked = {"model_type": about.model_type, "registers": about.registers, "hidden_size": about.hidden_size}
    found = {name: getattr(backbone, name) for name in asked}
    if asked != found:
        what = ", ".join(
            f"{name} {asked[name]} not {found[name]}" for name in asked if asked[name] != found[name]
        )
    elif about.layers > backbone.layers:
        what = f"it takes {about.layers} layers of {backbone.layers}"
    elif about.weights != backbone.weights:
        what = f"weights {about.weights}, not {backbone.weights}"
    else:
        return
    raise TaskError(
        f"the head was trained on {about.backbone}, which {backbone.name} is not ({what}); "
        "set segment.backbone to that model's folder, or train a head on this one"
    )


def predictor(head: Head, backbone: Backbone, of: str = "road") -> Predict:
    """Return what gives the probability of a class for every pixel of windows.

    The logits of the patches are interpolated (bilinear) to the pixels, as DINOv2's segmentation heads do.
    """
    import torch

    row = head.about.classes.index(of)
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
