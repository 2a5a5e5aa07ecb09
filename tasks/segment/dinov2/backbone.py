"""DINOv2 as a frozen backbone: windows of an orthophoto -> tokens of their patches.

Weights are read from Hugging Face's cache or a local folder, once per process; a run never downloads them.
The packages are installed by the extra ``flexroad[dinov2]``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from flexroad.catalog.lazy import lazy
from flexroad.tasks.errors import TaskError
from flexroad.tasks.types import Orthophoto

dinov2 = lazy("transformers.models.dinov2.modeling_dinov2")
dinov2_with_registers = lazy("transformers.models.dinov2_with_registers.modeling_dinov2_with_registers")
huggingface_hub = lazy("huggingface_hub")
transformers = lazy("transformers")

if TYPE_CHECKING:
    import torch
else:
    torch = lazy("torch")

Device = Literal["auto", "cpu", "cuda"]
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and standard deviation of red, green and blue (0 to 1) that DINOv2 was trained with (ImageNet)."""
EXAMPLE = "facebook/dinov2-small"
PATCH = 14
"""Side of a patch (pixels), of all DINOv2 models."""
MODEL_TYPES = ("dinov2", "dinov2_with_registers")


def normalised(
    photo: Orthophoto, mean: tuple[float, float, float] = MEAN, std: tuple[float, float, float] = STD
) -> NDArray[np.float32]:
    """Return a photo normalised for the backbone, ``(3, h, w)``; 0, the mean colour, where it has no data."""
    centre, spread = (np.array(v, np.float32)[:, None, None] for v in (mean, std))
    return np.where(photo.known, (photo.colour.astype(np.float32) / 255 - centre) / spread, np.float32(0))


def missing_extra(error: ImportError) -> TaskError:
    """Return the error to raise when a package of the extra is not installed."""
    package = (error.name or str(error)).split(".")[0]
    return TaskError(f'DINOv2 needs {package}: pip install "flexroad[dinov2]"')


@contextmanager
def gpu_memory() -> Iterator[None]:
    """Raise a TaskError with the remedy if the GPU has too little memory."""
    try:
        yield
    except torch.OutOfMemoryError as error:
        raise TaskError("the GPU has too little memory; use a smaller batch or fewer workers") from error


@dataclass(frozen=True, eq=False)
class Backbone:
    """A frozen DINOv2 on its device."""

    name: str
    """Hub name or folder, as requested."""
    model: Any
    """`transformers.Dinov2Model` or `Dinov2WithRegistersModel`."""
    device: str
    half: bool
    """Whether it computes in half precision."""
    weights: str
    """Hash that identifies the weights."""

    @property
    def model_type(self) -> str:
        """``dinov2`` or ``dinov2_with_registers``."""
        return str(self.model.config.model_type)

    @property
    def registers(self) -> int:
        """Number of register tokens: tokens of no patch, in addition to the class token."""
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
        """Return the tokens of the patches, ``(n, h, w, layers * hidden_size)``, float32 on the device.

        The tokens of the last ``layers`` layers, each passed through the model's final layer norm, are
        concatenated, as for the linear segmentation heads of the DINOv2 paper (Oquab et al. 2023).

        - `windows`: normalised by `MEAN` and `STD`; ``size`` is a multiple of `PATCH`.
        """
        side = windows.shape[-1] // PATCH
        dtype = torch.float16 if self.device == "cuda" else torch.bfloat16
        with gpu_memory(), torch.inference_mode(), torch.autocast(self.device, dtype, enabled=self.half):
            pixels = torch.from_numpy(windows).to(self.device)
            states = self.model(pixel_values=pixels, output_hidden_states=True).hidden_states[-layers:]
            patches = [self.model.layernorm(state)[:, 1 + self.registers :].float() for state in states]
        return torch.cat(patches, dim=-1).unflatten(1, (side, side))


@lru_cache(maxsize=1)
def load_backbone(name: str, device: Device = "auto", half: bool = False) -> Backbone:
    """Read a backbone from the cache or a folder; the last one read is kept in memory.

    - `name`: hub name (``facebook/dinov2-small``, ``facebook/dinov2-with-registers-base``) or folder with
      ``config.json`` and ``model.safetensors``.
    - `device`: ``auto`` uses a GPU if there is one.
    - `half`: compute in half precision: float16 on a GPU, bfloat16 on the CPU.
    """
    try:
        has_gpu = torch.cuda.is_available()
        transformers.utils.logging.disable_progress_bar()
    except ImportError as error:
        raise missing_extra(error) from error
    if device == "cuda" and not has_gpu:
        raise TaskError("no device 'cuda' on this machine; set segment.device to cpu or auto")
    target = "cuda" if has_gpu and device != "cpu" else "cpu"
    if target == "cpu":
        # One thread per process: each process works on its own tile.
        torch.set_num_threads(1)
    folder = _folder(name)
    model_class = _model_class(folder, name)
    try:
        model, info = model_class.from_pretrained(
            folder, local_files_only=True, use_safetensors=True, output_loading_info=True
        )
    except ImportError:
        raise
    except Exception as error:  # transformers raises many types for damaged files
        raise TaskError(
            f"cannot read the weights in {folder}: {' '.join(str(error).split())[:200]}; {_remedy(name)}"
        ) from error
    if info["missing_keys"]:
        raise TaskError(f"{folder}: weights lack {len(info['missing_keys'])} arrays; {_remedy(name)}")
    if model.config.patch_size != PATCH:
        raise TaskError(
            f"{folder}: patches of {model.config.patch_size} pixels, not {PATCH}; {_remedy(name)}"
        )
    ends = (model.embeddings.patch_embeddings.projection.weight, model.layernorm.weight, model.layernorm.bias)
    content = b"".join(end.detach().float().cpu().numpy().tobytes() for end in ends)
    identity = hashlib.sha256(content).hexdigest()[:16]
    with gpu_memory():
        model = model.eval().requires_grad_(False).to(target)
    return Backbone(name, model, target, half, identity)


def _folder(name: str) -> Path:
    path = Path(name).expanduser()
    if path.is_dir():
        return path
    try:
        return Path(huggingface_hub.snapshot_download(name, local_files_only=True))
    except huggingface_hub.errors.HFValidationError as error:
        raise TaskError(
            f"no folder {name} with a DINOv2 model, and {name} is not a hub name like {EXAMPLE}"
        ) from error
    except huggingface_hub.errors.LocalEntryNotFoundError as error:
        raise TaskError(f"the weights of {name} are not on this machine; {_remedy(name)}") from error


def _remedy(name: str) -> str:
    hub = EXAMPLE if Path(name).expanduser().is_dir() else name
    return f"get them by `hf download {hub}`, or give the folder of a copy as backbone"


def _model_class(folder: Path, name: str) -> Any:
    try:
        model_type = json.loads((folder / "config.json").read_text())["model_type"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TaskError(f"{folder} has no readable config.json of a model; {_remedy(name)}") from error
    if model_type not in MODEL_TYPES:
        raise TaskError(f"{folder} holds a model of type {model_type!r}, not one of {', '.join(MODEL_TYPES)}")
    # Import only the model's module: importing all of transformers takes seconds.
    return dinov2.Dinov2Model if model_type == "dinov2" else dinov2_with_registers.Dinov2WithRegistersModel
