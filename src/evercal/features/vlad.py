"""VLAD: one vector for an image, to retrieve similar images (Jegou et al., CVPR 2010).

The features of an image are summed as differences from the nearest of a few centroids. Centroids of
the shipped encoder come from procedural rooms. Centroids of another encoder are fitted to the first
recording that is learned with it, and travel with the map.
"""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from weakref import WeakKeyDictionary

import torch
from safetensors import safe_open
from torch import Tensor, nn
from torch.nn import functional as F

from evercal.errors import InputError
from evercal.features.encoder import WEIGHTS, Encoder
from evercal.features.weights_file import network_bytes
from evercal.storage.atomic import write_bytes

VLAD_FILE = WEIGHTS / "vlad.safetensors"
CENTROIDS = 32
WIDTH = 1024
_ROUNDS = 15
_ROWS = 40_000
"""Features that centroids are fitted to, at most."""


class Vlad:
    """Aggregate the features of an image in one vector.

    Centroids (k, channels) are unit vectors; the projection is (k * channels, width).
    """

    def __init__(self, centroids: Tensor, projection: Tensor):
        self.centroids, self.projection = centroids, projection
        self._copies: dict[torch.device, tuple[Tensor, Tensor]] = {}

    @torch.inference_mode()
    def __call__(self, features: Tensor) -> Tensor:
        """(cells, channels) unit vectors of an image -> (width,) unit vector, on their device."""
        centroids, projection = self._on(features.device)
        nearest = (features @ centroids.T).argmax(1)
        difference = features - centroids[nearest]
        if features.device.type == "cpu":
            sums = torch.zeros_like(centroids).index_add_(0, nearest, difference)
        else:  # `index_add_` on CUDA is not deterministic
            sums = F.one_hot(nearest, len(centroids)).to(difference.dtype).T @ difference
        vector = F.normalize(sums, dim=1).flatten()
        return F.normalize(vector @ projection, dim=0)

    def _on(self, device: torch.device) -> tuple[Tensor, Tensor]:
        if device not in self._copies:
            self._copies[device] = self.centroids.to(device), self.projection.to(device)
        return self._copies[device]


_by_encoder: WeakKeyDictionary[Encoder, Vlad] = WeakKeyDictionary()


def vlad_for(encoder: Encoder, features: Sequence[Tensor] = ()) -> Vlad:
    """The VLAD of an encoder; missing centroids are fitted to features (cells, channels)."""
    if encoder not in _by_encoder:
        centroids = shipped_centroids(encoder)
        if centroids is None and not features:
            raise InputError("the encoder has no VLAD centroids; learn a recording with it first")
        keep_centroids(encoder, fit_centroids(features) if centroids is None else centroids)
    return _by_encoder[encoder]


def lacks_centroids(encoder: Encoder) -> bool:
    """Whether centroids are still to be fitted."""
    return encoder not in _by_encoder and shipped_centroids(encoder) is None


def known_centroids(encoder: Encoder) -> Tensor | None:
    """(k, channels) centroids that were fitted or loaded in this process; None without any."""
    return _by_encoder[encoder].centroids if encoder in _by_encoder else None


def keep_centroids(encoder: Encoder, centroids: Tensor) -> None:
    """Use centroids (k, channels), fitted or loaded here or in another process."""
    # A fixed random projection to fewer numbers preserves angles.
    shape = (centroids.numel(), WIDTH)
    generator = torch.Generator().manual_seed(1)
    projection = torch.randn(shape, generator=generator, device="cpu")
    _by_encoder[encoder] = Vlad(centroids, projection / shape[0] ** 0.5)


def shipped_centroids(encoder: Encoder) -> Tensor | None:
    """(k, channels) centroids of the shipped encoder; None for another encoder."""
    if isinstance(encoder, nn.Module) and VLAD_FILE.exists():
        with safe_open(VLAD_FILE, "pt") as file:
            if (file.metadata() or {}).get("encoder") == _digest(encoder):
                return file.get_tensor("centroids").float()
    return None


def save_centroids(encoder: Encoder, path: Path) -> None:
    """Write the centroids of an encoder with the digest of its weights."""
    from safetensors.torch import save

    assert isinstance(encoder, nn.Module), "only modules have weights"
    centroids = vlad_for(encoder).centroids.contiguous()
    write_bytes(path, save({"centroids": centroids}, {"encoder": _digest(encoder)}))


def load_centroids(encoder: Encoder, path: Path) -> None:
    """Load the centroids of an encoder from a file of `save_centroids`."""
    with safe_open(path, "pt") as file:
        keep_centroids(encoder, file.get_tensor("centroids").float())


def fit_centroids(features: Sequence[Tensor]) -> Tensor:
    """(k, channels) centroids of unit features (cells, channels) of images, spherical k-means."""
    rows = torch.cat(list(features)).float().cpu()
    generator = torch.Generator().manual_seed(0)
    rows = rows[torch.randperm(len(rows), generator=generator)[:_ROWS]]
    centroids = rows[:CENTROIDS]
    for _ in range(_ROUNDS):
        nearest = (rows @ centroids.T).argmax(1)
        sums = torch.zeros_like(centroids).index_add_(0, nearest, rows)
        # A centroid without members stays where it is.
        used = sums.norm(dim=1, keepdim=True) > 0
        centroids = torch.where(used, F.normalize(sums, dim=1), centroids)
    return centroids


def _digest(encoder: nn.Module) -> str:
    return hashlib.sha256(network_bytes(encoder, "encoder")).hexdigest()
