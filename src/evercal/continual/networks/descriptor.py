"""The global descriptor: one vector per image that identifies the scene."""

import copy
import json
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from evercal.continual.networks.device import device_of_network
from evercal.errors import InputError
from evercal.features.encoder import WEIGHTS
from evercal.typing import Float32Array

DESCRIPTOR_FILE = WEIGHTS / "descriptor.safetensors"
"""The shipped descriptor; beside another encoder, the file of its own descriptor has this name."""
DESCRIBED_ENCODER = WEIGHTS / "encoder-1.onnx"
"""The encoder whose features the shipped descriptor was trained with."""


class GlobalDescriptor(nn.Module):
    """Attention-weighted pooling of local features, one vector per image.

    A small MLP lifts each cell's feature, several attention maps pool the result (like the soft
    assignment of NetVLAD, Arandjelovic et al., CVPR 2016), and a linear layer projects it.
    """

    def __init__(self, inputs: int, maps: int = 8, hidden: int = 64, width: int = 128):
        super().__init__()
        self.width = width
        self.settings = {
            "inputs": inputs,
            "maps": maps,
            "hidden": hidden,
            "width": width,
        }
        self.lift = nn.Conv2d(inputs, hidden, 1)
        self.value = nn.Conv2d(hidden, hidden, 1)
        self.attention = nn.Conv2d(hidden, maps, 1)
        self.project = nn.Linear(maps * hidden, width)

    def forward(self, features: Tensor) -> Tensor:
        """Map (b, inputs, h, w) local features of any grid size to (b, width) unit vectors."""
        lifted = F.relu(self.lift(features))
        weights = self.attention(lifted).flatten(2).softmax(-1)
        values = self.value(lifted).flatten(2)
        pooled = torch.einsum("bmn,bcn->bmc", weights, values)
        pooled = F.normalize(pooled, dim=-1).flatten(1)
        return F.normalize(self.project(pooled), dim=-1)


class PooledDescriptor(nn.Module):
    """A descriptor without trained weights, for encoders that have no descriptor of their own.

    It projects the mean and standard deviation of the features by a fixed random matrix.
    """

    projection: Tensor

    def __init__(self, inputs: int, width: int = 128):
        super().__init__()
        self.width = width
        self.settings = {"inputs": inputs, "width": width}
        generator = torch.Generator().manual_seed(0)
        projection = torch.randn(2 * inputs, width, generator=generator, device="cpu")
        self.register_buffer("projection", projection / inputs**0.5)

    def forward(self, features: Tensor) -> Tensor:
        """Map (b, inputs, h, w) local features of any grid size to (b, width) unit vectors."""
        cells = features.flatten(2)
        pooled = torch.cat([cells.mean(-1), cells.std(-1)], -1)
        pooled = F.normalize(pooled, dim=-1)
        return F.normalize(pooled @ self.projection, dim=-1)


Descriptor = GlobalDescriptor | PooledDescriptor


def load_descriptor(path: Path = DESCRIPTOR_FILE) -> Descriptor:
    """Load a descriptor for inference, by default the shipped one."""
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise InputError(f"descriptor {path}: no such file")
    try:
        with safe_open(path, "pt") as file:
            settings = json.loads((file.metadata() or {})["descriptor"])
            state = {key: file.get_tensor(key).float() for key in file.keys()}  # noqa: SIM118
        layout = GlobalDescriptor
        if settings.pop("layout", None) == PooledDescriptor.__name__:
            layout = PooledDescriptor
        descriptor = layout(**settings)
        descriptor.load_state_dict(state)
    except (SafetensorError, LookupError, ValueError, TypeError, RuntimeError) as error:
        raise InputError(
            f"descriptor {path}: not an evercal descriptor ({error!r})"
        ) from error
    return descriptor.eval()


def descriptor_bytes(descriptor: Descriptor) -> bytes:
    """Serialise a descriptor in half precision, with its settings as metadata."""
    from safetensors.torch import save

    state = copy.deepcopy(descriptor).cpu().half().state_dict()
    settings = {**descriptor.settings, "layout": type(descriptor).__name__}
    return save(state, {"descriptor": json.dumps(settings)})


def descriptor_for(encoder_file: Path, inputs: int) -> Descriptor:
    """Return the descriptor for a user's encoder: the file beside it, or an untrained one."""
    sibling = encoder_file.with_name(DESCRIPTOR_FILE.name)
    if sibling.is_file() and sibling != encoder_file:
        descriptor = load_descriptor(sibling)
        if descriptor.settings["inputs"] == inputs:
            return descriptor
    return PooledDescriptor(inputs)


@torch.inference_mode()
def described(features: Float32Array, descriptor: Descriptor) -> tuple[Tensor, Tensor]:
    """Convert the features (rows, columns, channels) of an image, and describe it.

    Returns features (rows * columns, channels) and descriptor (width,), on the descriptor's device.
    """
    grid = torch.from_numpy(features).to(device_of_network(descriptor))
    [vector] = descriptor(grid.permute(2, 0, 1)[None])
    return grid.flatten(0, 1), vector
