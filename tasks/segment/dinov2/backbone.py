"""DINOv2 as a frozen backbone: windows of an orthophoto -> the tokens of its patches.

Weights come from Hugging Face's cache or a local folder; nothing is ever downloaded in a run. The packages
are the extra ``flexroad[dinov2]``; the model is read once per process.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Orthophoto

if TYPE_CHECKING:
    import torch

Device = Literal["auto", "cpu", "cuda"]
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of red, green and blue from 0 to 1: what DINOv2 was trained with (ImageNet)."""
EXAMPLE = "facebook/dinov2-small"
PATCH = 14
"""Side of a patch (pixels), of all DINOv2 models."""
KINDS = ("dinov2", "dinov2_with_registers")


def normalised(
    photo: Orthophoto, mean: tuple[float, float, float] = MEAN, std: tuple[float, float, float] = STD
) -> NDArray[np.float32]:
    """Return a photo as the backbone wants it, ``(3, h, w)``; what is unknown has the mean colour."""
    centre, spread = (np.array(v, np.float32)[:, None, None] for v in (mean, std))
    return np.where(photo.known, (photo.colour.astype(np.float32) / 255 - centre) / spread, np.float32(0))


def missing_extra(error: ImportError) -> TaskError:
    """Return what to say where the extra is not installed."""
    package = (error.name or str(error)).split(".")[0]
    return TaskError(f'DINOv2 needs {package}: pip install "flexroad[dinov2]"')


@dataclass(frozen=True, eq=False)
class Backbone:
    """A frozen DINOv2, ready on its device."""

    name: str
    """As it was asked for: hub name or folder."""
    model: Any
    """`transformers.Dinov2Model` or `Dinov2WithRegistersModel`."""
    device: str
    half: bool
    weights: str
    """Names these weights among all others of the same shape."""

    @property
    def model_type(self) -> str:
        """``dinov2`` or ``dinov2_with_registers``."""
        return str(self.model.config.model_type)

    @property
    def registers(self) -> int:
        """Tokens that stand for no patch, beside the first one."""
        return int(getattr(self.model.config, "num_register_tokens", 0))

    @property
    def hidden_size(self) -> int:
        """Length of a token."""
        return int(self.model.config.hidden_size)

    @property
    def layers(self) -> int:
        """Number of transformer blocks."""
        return int(self.model.config.num_hidden_layers)

    def tokens(self, windows: NDArray[np.float32], layers: int) -> torch.Tensor:
        """Return the patches' tokens, ``(n, h, w, layers * hidden_size)``, float32 on the device.

        Of the last ``layers`` layers, each passed through the model's final layer norm, one after the other:
        what the linear segmentation heads of the DINOv2 paper (Oquab et al. 2023) take.

        Parameters
        ----------
        windows : (n, 3, size, size) array
            Normalised by `MEAN` and `STD`; ``size`` is a multiple of the patch.
        """
        import torch

        side = windows.shape[-1] // PATCH
        dtype = torch.float16 if self.device == "cuda" else torch.bfloat16
        with torch.inference_mode(), torch.autocast(self.device, dtype, enabled=self.half):
            pixels = torch.from_numpy(windows).to(self.device)
            states = self.model(pixel_values=pixels, output_hidden_states=True).hidden_states[-layers:]
            patches = [self.model.layernorm(state)[:, 1 + self.registers :].float() for state in states]
        return torch.cat(patches, dim=-1).unflatten(1, (side, side))


@lru_cache(maxsize=1)
def load_backbone(name: str, device: Device = "auto", half: bool = False) -> Backbone:
    """Read a backbone from the cache or a folder; the last one read is kept.

    Parameters
    ----------
    name : str
        Hub name (``facebook/dinov2-small``, ``facebook/dinov2-with-registers-base``) or folder with
        ``config.json`` and ``model.safetensors``.
    device : str
        ``auto`` takes a GPU where there is one.
    half : bool
        Compute in half precision: float16 on a GPU, bfloat16 on the CPU.

    Raises
    ------
    TaskError
        If the extra, the weights or the device are missing, or the files are no DINOv2.
    """
    try:
        import torch
        from transformers.utils import logging
    except ImportError as error:
        raise missing_extra(error) from error
    has_gpu = torch.cuda.is_available()
    if device == "cuda" and not has_gpu:
        raise TaskError("no device 'cuda' on this machine; set segment.device to cpu or auto")
    where = "cuda" if has_gpu and device != "cpu" else "cpu"
    if where == "cpu":
        # Processes share the cores tile by tile.
        torch.set_num_threads(1)
    folder = _folder(name)
    kind = _kind(folder, name)
    logging.disable_progress_bar()
    try:
        model, found = kind.from_pretrained(
            folder, local_files_only=True, use_safetensors=True, output_loading_info=True
        )
    except Exception as error:  # whatever is wrong with the files, transformers may raise
        raise TaskError(f"cannot read the weights in {folder}: {_line(error)}; {_how(name)}") from error
    if found["missing_keys"]:
        raise TaskError(f"{folder}: weights lack {len(found['missing_keys'])} arrays; {_how(name)}")
    if model.config.patch_size != PATCH:
        raise TaskError(f"{folder}: patches of {model.config.patch_size} pixels, not {PATCH}; {_how(name)}")
    identity = _identity(model)
    return Backbone(name, model.eval().requires_grad_(False).to(where), where, half, identity)


def _folder(name: str) -> Path:
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HFValidationError, LocalEntryNotFoundError

    path = Path(name).expanduser()
    if path.is_dir():
        return path
    try:
        return Path(snapshot_download(name, local_files_only=True))
    except HFValidationError as error:
        raise TaskError(
            f"no folder {name} with a DINOv2 model, nor is it a hub name like {EXAMPLE}"
        ) from error
    except LocalEntryNotFoundError as error:
        raise TaskError(f"the weights of {name} are not on this machine; {_how(name)}") from error


def _how(name: str) -> str:
    hub = EXAMPLE if Path(name).expanduser().is_dir() else name
    return f"get them by `hf download {hub}`, or give the folder of a copy as backbone"


def _kind(folder: Path, name: str) -> Any:
    try:
        kind = json.loads((folder / "config.json").read_text())["model_type"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TaskError(f"{folder} has no readable config.json of a model; {_how(name)}") from error
    if kind not in KINDS:
        raise TaskError(f"{folder} holds a model of type {kind!r}, not one of {', '.join(KINDS)}")
    # Only what is needed: the whole of transformers takes seconds.
    if kind == "dinov2":
        from transformers.models.dinov2.modeling_dinov2 import Dinov2Model

        return Dinov2Model
    from transformers.models.dinov2_with_registers.modeling_dinov2_with_registers import (
        Dinov2WithRegistersModel,
    )

    return Dinov2WithRegistersModel


def _identity(model: Any) -> str:
    """Return a name for the weights, by the first and the last of them: the patches' and the layer norm's."""
    ends = (model.embeddings.patch_embeddings.projection.weight, model.layernorm.weight, model.layernorm.bias)
    content = b"".join(end.detach().float().cpu().numpy().tobytes() for end in ends)
    return hashlib.sha256(content).hexdigest()[:16]


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
