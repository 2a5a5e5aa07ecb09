"""Tiny DINOv2 models with random weights, saved as folders, for tests without a download."""

from pathlib import Path


def save_backbone(
    folder: Path, registers: int = 0, seed: int = 0, hidden_size: int = 48, layers: int = 3
) -> Path:
    """Save a model; with ``registers`` above 0 it is a model with register tokens."""
    import torch
    from transformers.models.dinov2.configuration_dinov2 import Dinov2Config
    from transformers.models.dinov2.modeling_dinov2 import Dinov2Model
    from transformers.models.dinov2_with_registers.configuration_dinov2_with_registers import (
        Dinov2WithRegistersConfig,
    )
    from transformers.models.dinov2_with_registers.modeling_dinov2_with_registers import (
        Dinov2WithRegistersModel,
    )

    torch.manual_seed(seed)
    size = {
        "hidden_size": hidden_size,
        "num_hidden_layers": layers,
        "num_attention_heads": 2,
        "mlp_ratio": 2,
        "image_size": 56,
        "patch_size": 14,
        # Random layers hardly change their input; larger weights make tokens attend to others.
        "initializer_range": 0.1,
    }
    if registers:
        config = Dinov2WithRegistersConfig(**size, num_register_tokens=registers)
        model = Dinov2WithRegistersModel(config)
    else:
        model = Dinov2Model(Dinov2Config(**size))
    model.save_pretrained(folder)
    return folder
