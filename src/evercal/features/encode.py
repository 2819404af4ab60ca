"""Features of images from the frozen encoder."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from evercal.features.device import device_of_network
from evercal.features.encoder import Encoder
from evercal.features.precision import autocast
from evercal.features.views import working_image
from evercal.geometry import Camera

ENCODE_BATCH = 8
"""Views that go through the encoder together."""


@torch.inference_mode()
def encode_features(images: Sequence[np.ndarray], encoder: Encoder) -> Tensor:
    """(b, channels, rows, columns) of grey images (h, w) of one size, on the encoder's device."""
    device = device_of_network(encoder)
    grey = torch.from_numpy(np.stack(images))[:, None].to(device)
    with autocast(device):
        return encoder(grey.float() / 255.0).float()


def encode_image(image: np.ndarray, encoder: Encoder, short_side: int) -> Tensor:
    """(channels, rows, columns) features of an image, on the encoder's device."""
    height, width = image.shape[:2]
    plain = Camera(width, height, width, width, (width - 1) / 2, (height - 1) / 2)
    return encode_features([working_image(image, plain, short_side)[0]], encoder)[0]
