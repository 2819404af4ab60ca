"""Networks as safetensors files that contain their settings."""

import json
from collections.abc import Mapping

import torch

from evercal.errors import InputError


def network_bytes(module: torch.nn.Module, kind: str) -> bytes:
    """Serialise a network in half precision; its settings are the metadata value of `kind`."""
    from safetensors.torch import save

    state = {k: v.detach().cpu().half().contiguous() for k, v in module.state_dict().items()}
    settings = getattr(module, "settings", {})
    layout = {"layout": type(module).__name__}
    return save(state, {kind: json.dumps(settings | layout)})


def load_strictly(module: torch.nn.Module, state: Mapping[str, object], name: str) -> None:
    """Load a state dict with exactly the keys and shapes of a module; `name` begins the error."""
    try:
        module.load_state_dict(dict(state), strict=True)
    except RuntimeError as error:
        first = str(error).splitlines()[1].strip()  # line 0 is the class of the module
        raise InputError(f"{name}: {first}") from error
