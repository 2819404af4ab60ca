"""Encoder and descriptor as safetensors bytes, with what is needed to build them again."""

import json
from collections.abc import Mapping

import torch

from evercal.errors import InputError


def network_bytes(module: torch.nn.Module, kind: str) -> bytes:
    """A network in half precision; `kind` is the metadata key that its loader looks for."""
    from safetensors.torch import save

    state = {k: v.detach().cpu().half().contiguous() for k, v in module.state_dict().items()}
    settings = getattr(module, "settings", {})
    layout = {"layout": type(module).__name__}
    return save(state, {kind: json.dumps(settings | layout)})


def load_strictly(module: torch.nn.Module, state: Mapping[str, object], name: str) -> None:
    """Loads a state dict whose keys and shapes must match exactly.

    Raises:
        InputError: `name` and the first thing that does not match, in one line.
    """
    try:
        module.load_state_dict(dict(state), strict=True)
    except RuntimeError as error:
        first = str(error).splitlines()[1].strip()  # line 0 names torch's class
        raise InputError(f"{name}: {first}") from error
