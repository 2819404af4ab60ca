"""Keyframes per scene: a share of the frames, a size in bytes, or the fewest needed."""

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from evercal.classes import frozen
from evercal.errors import InputError, require_numbers
from evercal.mapping.selection import spread_poses
from evercal.recordings.frame import Frame
from evercal.typing import IntArray

if TYPE_CHECKING:
    from evercal.mapping.keyframes import Keyframes

AUTO = "auto"
FEW_KEYFRAMES = 8
"""The default keeps at least so many: two keyframes of a recording of 25 frames locate 76 to 91 %
of its other frames within 1 cm, eight locate all (research/map.md)."""
_UNITS = {
    "": 1,
    "B": 1,
    "KB": 10**3,
    "MB": 10**6,
    "GB": 10**9,
}
"""Bytes of a decimal unit."""
_UNITS |= {"KIB": 2**10, "MIB": 2**20, "GIB": 2**30}
_SAMPLED_FRAMES = 8
"""Frames whose size as keyframes is measured, for a budget in bytes."""


@frozen
class MemoryBudget:
    """Memory of one scene."""

    share: float = 0.10
    """Keyframes as a share of the training frames."""
    bytes: int | None = None
    """Maximum size of the keyframes, instead of a share."""
    least: int = 1
    """Minimum number of keyframes of a share; a recording with fewer frames keeps them all."""
    auto: bool = False
    """Keep the fewest keyframes that locate the recording's other frames well."""

    def __post_init__(self) -> None:
        """Refuse numbers outside their range.

        Raises:
            InputError: A share above 1, or a number of keyframes or bytes below 1.
        """
        require_numbers(self, ("share",), 0, 1)
        require_numbers(self, ("least",), 1)
        if self.bytes is not None:
            require_numbers(self, ("bytes",), 1)

    @classmethod
    def parse(cls, memory: str | int | None) -> "MemoryBudget":
        """Read a budget: `10%`, `5MB`, `512KiB` or `auto`; the text `100000` is a size in bytes.

        A number is that of keyframes. The default, None, is 10 % and at least `FEW_KEYFRAMES`.
        """
        if memory is None:
            return cls(least=FEW_KEYFRAMES)
        if isinstance(memory, int):
            return cls(share=0.0, least=memory)
        text = str(memory).strip()
        if text.lower() == AUTO:
            return cls(auto=True)
        pattern = r"(\d+(?:\.\d+)?)\s*(%|[kmg]?i?b?)"
        match = re.fullmatch(pattern, text, re.IGNORECASE | re.ASCII)
        if match:
            number = float(match[1])
            unit = match[2].upper()
            if unit == "%" and 0 < number <= 100:
                return cls(share=number / 100)
            if unit in _UNITS and number * _UNITS[unit] >= 1:
                return cls(bytes=int(number * _UNITS[unit]))
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
        size = store_keyframes(sample, short_side).bytes / len(sample)
        return min(len(frames), max(1, int(self.bytes / size)))

    def fitting(self, keyframes: "Keyframes") -> IntArray:
        """Indices of the keyframes that fit into the budget: spread by pose, at least one."""
        total = len(keyframes)
        if self.bytes is None or keyframes.bytes <= self.bytes:
            return np.arange(total)
        first = min(total - 1, total * self.bytes // keyframes.bytes + 1)
        for count in range(first, 1, -1):
            selected = spread_poses(keyframes.base_from_camera, count)
            if keyframes.take(selected).bytes <= self.bytes:
                return selected
        return np.arange(1)
