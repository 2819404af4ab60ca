"""Features and descriptors of views, as the frozen networks give them."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from evercal.features.descriptor import Descriptor
from evercal.features.encoder import Encoder
from evercal.features.precision import autocast
from evercal.features.views import View

ENCODE_BATCH = 8
"""Views that go through the encoder together."""


@torch.inference_mode()
def encode_features(views: Sequence[View], encoder: Encoder) -> Tensor:
    """Features (b, channels, h, w) of views of one size."""
    grey = torch.from_numpy(np.stack([view.grey for view in views]))[:, None].float() / 255.0
    with autocast():
        return encoder(grey).float()


@torch.inference_mode()
def encode(
    views: Sequence[View], encoder: Encoder, descriptor: Descriptor
) -> tuple[Tensor, Tensor]:
    """Features (b, channels, h, w) and descriptors (b, width) of views of one size."""
    features = encode_features(views, encoder)
    return features, descriptor(features)
