"""A box room and an encoder that needs no training."""

from ..box_world import block_mean, box, shoot

__all__ = ["block_mean", "box", "shoot"]
