"""A box room and networks that need no training."""

from ...box_world import box, learnable

__all__ = ["box", "learnable"]
