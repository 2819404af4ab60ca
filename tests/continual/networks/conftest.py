"""A box room and networks that need no training."""

from ...box_world import block_mean, box, shoot
from ..box_features import describe, learnable

__all__ = ["block_mean", "box", "describe", "learnable", "shoot"]
