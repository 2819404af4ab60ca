"""A box room and networks that need no training."""

from ...box_world import box
from ..box_features import learnable

__all__ = ["box", "learnable"]
