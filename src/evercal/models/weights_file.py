"""Encoder and descriptor as safetensors bytes, with what is needed to build them again."""

import json

import torch


def network_bytes(module: torch.nn.Module, kind: str) -> bytes:
    """A network in half precision; `kind` is the metadata key that its loader looks for."""
    from safetensors.torch import save

    state = {k: v.detach().half().contiguous() for k, v in module.state_dict().items()}
    settings = getattr(module, "settings")  # noqa: B009
    layout = {"layout": type(module).__name__}
    return save(state, {kind: json.dumps(settings | layout)})
