"""VLAD: one vector for a whole image, to find images of the same place (Jegou et al., CVPR 2010).

The features of an image are summed up as differences from the nearest of a few centroids. The
centroids come from procedural rooms, so nothing about them belongs to any scene.
"""

import hashlib
from pathlib import Path
from weakref import WeakKeyDictionary

import numpy as np
import torch
from safetensors import safe_open
from torch import Tensor, nn
from torch.nn import functional as F

from evercal.features.encode import encode_features
from evercal.features.encoder import WEIGHTS, Encoder
from evercal.features.views import ViewOptions, plain_view
from evercal.features.weights_file import network_bytes
from evercal.simulation.box_room import BoxRoom, default_camera
from evercal.storage.atomic import write_bytes

VLAD_FILE = WEIGHTS / "vlad.safetensors"
CENTROIDS = 32
WIDTH = 1024
_ROOMS = range(8_980, 8_988)
_VIEWS = 4
_ROUNDS = 15


class Vlad:
    """Makes a vector of an image's features.

    Args:
        centroids: (k, channels) unit vectors.
        projection: (k * channels, width).
    """

    def __init__(self, centroids: Tensor, projection: Tensor):
        self.centroids, self.projection = centroids, projection
        self._copies: dict[torch.device, tuple[Tensor, Tensor]] = {}

    @torch.inference_mode()
    def __call__(self, features: Tensor) -> Tensor:
        """(cells, channels) unit vectors of an image -> (width,) unit vector, on their device."""
        centroids, projection = self._on(features.device)
        nearest = (features @ centroids.T).argmax(1)
        apart = features - centroids[nearest]
        if features.device.type == "cpu":
            sums = torch.zeros_like(centroids).index_add_(0, nearest, apart)
        else:  # there `index_add_` adds in any order, and the last bits would change with it
            sums = F.one_hot(nearest, len(centroids)).to(apart.dtype).T @ apart
        whole = F.normalize(sums, dim=1).flatten()
        return F.normalize(whole @ projection, dim=0)

    def _on(self, device: torch.device) -> tuple[Tensor, Tensor]:
        """Centroids and projection on a device; moved there once."""
        if device not in self._copies:
            self._copies[device] = self.centroids.to(device), self.projection.to(device)
        return self._copies[device]


_made: WeakKeyDictionary[Encoder, Vlad] = WeakKeyDictionary()


def vlad_for(encoder: Encoder) -> Vlad:
    """The VLAD of an encoder: the shipped one, that of a store, or one that is made in seconds."""
    if encoder not in _made:
        shipped = shipped_centroids(encoder)
        _made[encoder] = _projected(fit_centroids(encoder) if shipped is None else shipped)
    return _made[encoder]


def shipped_centroids(encoder: Encoder) -> Tensor | None:
    """(k, channels) centroids of the shipped encoder; None for another one."""
    if isinstance(encoder, nn.Module) and VLAD_FILE.exists():
        with safe_open(VLAD_FILE, "pt") as file:
            if (file.metadata() or {}).get("encoder") == _digest(encoder):
                return file.get_tensor("centroids").float()
    return None


def save_centroids(encoder: Encoder, path: Path) -> None:
    """Writes the centroids of an encoder, whole or not at all, with the digest of its weights."""
    from safetensors.torch import save

    assert isinstance(encoder, nn.Module), "only modules have weights"
    centroids = vlad_for(encoder).centroids.contiguous()
    write_bytes(path, save({"centroids": centroids}, {"encoder": _digest(encoder)}))


def load_centroids(encoder: Encoder, path: Path) -> None:
    """Gives an encoder the centroids that were saved for it, so that none are fitted."""
    with safe_open(path, "pt") as file:
        _made[encoder] = _projected(file.get_tensor("centroids").float())


def fit_centroids(encoder: Encoder) -> Tensor:
    """(k, channels) centroids of the features of procedural rooms, by spherical k-means."""
    features = torch.cat([_room_features(encoder, seed) for seed in _ROOMS])
    generator = torch.Generator().manual_seed(0)
    centroids = features[
        torch.randperm(len(features), generator=generator, device="cpu")[:CENTROIDS]
    ]
    for _ in range(_ROUNDS):
        nearest = (features @ centroids.T).argmax(1)
        sums = torch.zeros_like(centroids).index_add_(0, nearest, features)
        # One that nothing is nearest to stays where it is.
        some = sums.norm(dim=1, keepdim=True) > 0
        centroids = torch.where(some, F.normalize(sums, dim=1), centroids)
    return centroids


def _projected(centroids: Tensor) -> Vlad:
    # A fixed random projection keeps angles well enough and a quarter of the numbers.
    shape = (centroids.numel(), WIDTH)
    drawn = torch.Generator().manual_seed(1)
    projection = torch.randn(shape, generator=drawn, device="cpu")
    return Vlad(centroids, projection / shape[0] ** 0.5)


def _digest(encoder: nn.Module) -> str:
    return hashlib.sha256(network_bytes(encoder, "encoder")).hexdigest()


def _room_features(encoder: Encoder, seed: int) -> Tensor:
    """(n, channels) every third feature of some views of a procedural room."""
    camera, room = default_camera(320, 240), BoxRoom(seed, texture_px=192)
    rng, rows = np.random.default_rng(seed), []
    for _ in range(_VIEWS):
        image = room.render(camera, room.random_view(rng))
        view = plain_view(image, camera, encoder.stride, ViewOptions())
        rows.append(encode_features([view], encoder, "cpu")[0].flatten(1).T[::3])
    return torch.cat(rows)
