"""The prepared image, and the keyframes of a scene that it is compared to."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from evercal.classes import frozen_arrays
from evercal.features.views import working_grey
from evercal.geometry import Camera
from evercal.localization.intrinsics import IntrinsicsPrior
from evercal.mapping.patches import image_pyramid
from evercal.typing import Array, Float32Array, Image, IntArray


@dataclass(eq=False)
class Encoded:
    """Features of an image, and what the `Matcher` computed from them."""

    features: Float32Array = field(
        default_factory=lambda: np.zeros((0, 0, 0), np.float32)
    )
    """(rows, columns, channels)."""
    scale: float = 1.0
    """Scale of the encoded image, relative to the encoder's working size."""
    turns: int = 0
    """Quarter turns clockwise of the image before it was encoded."""
    similarity: Float32Array | None = None
    """(keyframes,) similarity of the whole image; None before it is computed."""
    nearest: dict[tuple[int, int], tuple[Array, Float32Array]] = field(
        default_factory=dict
    )
    """Points and similarities of cells by stride and keyframe, see `Matcher`."""


@frozen_arrays
class Query:
    """An image to be located."""

    image: Image
    short_side: int
    """Maximum short side of `grey`, pixels."""
    cameras: Sequence[Camera]
    """Intrinsics in each scene, at the size of the image."""
    priors: Sequence[IntrinsicsPrior]
    """Priors of the intrinsics in each scene."""
    encoded: Encoded = field(default_factory=Encoded)
    """Empty where only landmarks are aligned."""

    @cached_property
    def grey(self) -> Image:
        """(h, w) image that landmarks are aligned in."""
        return working_grey(self.image, min(self.short_side, *self.image.shape[:2]))

    @cached_property
    def pyramid(self) -> list[Array]:
        """Image pyramid of `grey`."""
        return image_pyramid(self.grey, 2)

    def camera(self, scene: int) -> Camera:
        """Intrinsics in one scene, at the size of `grey`."""
        height, width = self.grey.shape
        return self.cameras[scene].resized(width, height)


class Candidate(NamedTuple):
    """A scene to try."""

    scene: int
    keyframes: IntArray
    """Its keyframes in the bank, most similar first."""
    stride: int = 1
    """Every n-th row and column of patches is matched."""
    thorough: bool = False
    """Whether more patches are matched than at first: after a retry, or of repeated texture."""
    tolerance: float = 1.0
    """See `Attempt.tolerance`."""
