"""Keyframes per scene: a share of the frames, a size in bytes, or the fewest needed."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from evercal.errors import InputError
from evercal.mapping.selection import spread_poses
from evercal.recordings.frame import Frame
from evercal.typing import IntArray

if TYPE_CHECKING:
    from evercal.mapping.keyframes import Keyframes

AUTO = "auto"
FEW_KEYFRAMES = 8
"""The default keeps at least so many: two keyframes of a recording of 25 frames locate 76 to 91 %
of its other frames within 1 cm, eight locate all (research/map.md)."""
_UNITS = {"": 1, "B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9}
_UNITS |= {"KIB": 2**10, "MIB": 2**20, "GIB": 2**30}
_SAMPLED_FRAMES = 8
"""Frames whose size as keyframes is measured, for a budget in bytes."""


@dataclass(frozen=True)
class MemoryBudget:
    """Memory of one scene."""

    share: float = 0.10
    """Keyframes as a share of the training frames."""
    bytes: int | None = None
    """Size of the keyframes instead, at most."""
    least: int = 1
    """Keyframes of a share, at least, as far as there are frames."""
    auto: bool = False
    """Keep the fewest keyframes that locate the recording's other frames well."""

    @classmethod
    def parse(cls, memory: str | int | None) -> "MemoryBudget":
        """Read a budget: `10%`, `5MB`, `512KiB`, `100000` or `auto`.

        The default, None, is 10 % and at least `FEW_KEYFRAMES`.
        """
        if memory is None:
            return cls(least=FEW_KEYFRAMES)
        text = str(memory).strip()
        if text.lower() == AUTO:
            return cls(auto=True)
        match = re.fullmatch(
            r"(\d+(?:\.\d+)?)\s*(%|[kmg]?i?b?)", text, re.IGNORECASE | re.ASCII
        )
        unit = match[2].upper() if match else ""
        if match and unit == "%" and 0 < float(match[1]) <= 100:
            return cls(share=float(match[1]) / 100)
        if match and unit in _UNITS and float(match[1]) * _UNITS[unit] >= 1:
            return cls(bytes=int(float(match[1]) * _UNITS[unit]))
        raise InputError(
            f"memory {memory}: give a share of the frames above 0% and up to 100%, a size such as"
            " 500kB, 5MB or 5MiB, or auto"
        )

    def capacity(self, frames: Sequence[Frame], short_side: int) -> int:
        """Number of keyframes, at least 1.

        For a budget in bytes, as many as fit by the size of their images, from a sample.
        """
        if self.bytes is None:
            least = min(self.least, len(frames))
            return max(least, int(self.share * len(frames) + 1e-9))
        from evercal.mapping.keyframes import store_keyframes

        sample = frames[:: -(-len(frames) // _SAMPLED_FRAMES)]
        one = store_keyframes(sample, short_side).bytes / len(sample)
        return min(len(frames), max(1, int(self.bytes / one)))

    def fitting(self, keyframes: "Keyframes") -> IntArray:
        """Indices of the keyframes that fit into the budget: spread by pose, at least one."""
        total = len(keyframes)
        if self.bytes is None or keyframes.bytes <= self.bytes:
            return np.arange(total)
        for count in range(
            min(total - 1, total * self.bytes // keyframes.bytes + 1), 1, -1
        ):
            selected = spread_poses(keyframes.base_from_camera, count)
            if keyframes.take(selected).bytes <= self.bytes:
                return selected
        return np.arange(1)
