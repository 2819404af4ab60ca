"""Features of views from the frozen encoder."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from evercal.features.device import device_of_network
from evercal.features.encoder import Encoder
from evercal.features.precision import autocast
from evercal.features.views import View, ViewOptions, plain_view
from evercal.geometry import Camera

ENCODE_BATCH = 8
"""Views that go through the encoder together."""


@torch.inference_mode()
def encode_features(
    views: Sequence[View], encoder: Encoder, device: torch.device | str | None = None
) -> Tensor:
    """Features (b, channels, h, w) of views of one size, fp32.

    By default they are on the device of the encoder's weights, on which it runs.
    """
    own = device_of_network(encoder)
    grey = torch.from_numpy(np.stack([view.grey for view in views]))[:, None].to(own)
    with autocast(own):
        features = encoder(grey.float() / 255.0).float()
    return features if device is None else features.to(device)


def encode_image(image: np.ndarray, encoder: Encoder, short_side: int) -> Tensor:
    """(channels, rows, columns) features of an image, on the encoder's device."""
    height, width = image.shape[:2]
    plain = Camera(width, height, width, width, (width - 1) / 2, (height - 1) / 2)
    view = plain_view(image, plain, encoder.stride, ViewOptions(short_side=short_side))
    return encode_features([view], encoder)[0]
