"""Features and descriptors of views, as the frozen networks give them.

The networks run where their weights lie, and what they give stays there unless the caller asks for
it elsewhere: maps are built on the CPU, rows are trained on where the buffer is told to keep them.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from evercal.continual.networks.descriptor import Descriptor
from evercal.features.device import device_of_network
from evercal.features.encoder import Encoder
from evercal.features.precision import autocast
from evercal.features.views import View

ENCODE_BATCH = 8
"""Views that go through the encoder together."""


@torch.inference_mode()
def encode_features(
    views: Sequence[View], encoder: Encoder, device: torch.device | str | None = None
) -> Tensor:
    """Features (b, channels, h, w) of views of one size, fp32.

    Args:
        views: b views.
        encoder: runs where its weights lie.
        device: where the features shall lie; the encoder's own device when None.
    """
    own = device_of_network(encoder)
    grey = torch.from_numpy(np.stack([view.grey for view in views]))[:, None].to(own)
    with autocast(own):
        features = encoder(grey.float() / 255.0).float()
    return features if device is None else features.to(device)


@torch.inference_mode()
def encode(
    views: Sequence[View], encoder: Encoder, descriptor: Descriptor
) -> tuple[Tensor, Tensor]:
    """Features (b, channels, h, w) and descriptors (b, width) of views of one size.

    Both lie on the encoder's device, where the descriptor's weights must lie too.
    """
    features = encode_features(views, encoder)
    return features, descriptor(features)
