"""How much of a scene is kept, as people write it: a share of its frames, or bytes."""

import dataclasses
import re
from typing import TYPE_CHECKING

from evercal.errors import InputError

if TYPE_CHECKING:
    from evercal.continual.stage import StageOptions

AUTO = "auto"
"""As few keyframes as locate the recording's other frames well."""
_UNITS = {"": 1, "B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9}
_UNITS |= {"KIB": 2**10, "MIB": 2**20, "GIB": 2**30}


def parse_memory(memory: str | int) -> tuple[float | None, int | None]:
    """(share of the frames, None) of `10%`, or (None, bytes) of `5MB`, `512KiB`, `100000`.

    Raises:
        InputError: Neither, or nothing at all to keep keyframes in.
    """
    match = re.fullmatch(
        r"\s*(\d+(?:\.\d+)?)\s*(%|[kmg]?i?b?)\s*", str(memory), re.IGNORECASE | re.ASCII
    )
    unit = match[2].upper() if match else ""
    if match and unit == "%" and 0 < float(match[1]) <= 100:
        return float(match[1]) / 100, None
    if match and unit in _UNITS and float(match[1]) * _UNITS[unit] >= 1:
        return None, int(float(match[1]) * _UNITS[unit])
    raise InputError(
        f"memory {memory}: give a share of the frames above 0% and up to 100%, or bytes such as"
        f" 500kB, 5MB or 5MiB, or auto"
    )


def with_memory(stage: "StageOptions", memory: str | int) -> "StageOptions":
    """The options with as much memory.

    Args:
        stage: how a scene is learned.
        memory: see `parse_memory`, or `auto`.

    Raises:
        InputError: as `parse_memory`.
    """
    if str(memory).strip().lower() == AUTO:
        return dataclasses.replace(stage, memory_auto=True, memory_bytes=None)
    share, count = parse_memory(memory)
    kept = stage.memory_share if share is None else share
    return dataclasses.replace(stage, memory_share=kept, memory_bytes=count, memory_auto=False)
