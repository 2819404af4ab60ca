"""Options of mapping refuse numbers outside their range; budgets of memory are read."""

import math
from typing import Any

import pytest

from evercal.errors import InputError
from evercal.mapping.build import MapOptions
from evercal.mapping.bundle_options import BundleOptions
from evercal.mapping.memory_budget import FEW_KEYFRAMES, MemoryBudget
from evercal.mapping.prepared_frames import WorkingSize
from evercal.mapping.refresh import RefreshOptions
from evercal.mapping.selection import SarsOptions
from evercal.recordings.frame import Recording


@pytest.mark.parametrize(
    ("kind", "field", "value"),
    [
        (MapOptions, "rounds", 0),
        (MapOptions, "support_frames", 0),
        (BundleOptions, "iterations", 0),
        (BundleOptions, "most_sigma_m", 0.0),
        (BundleOptions, "focal_sigma", math.nan),
        (BundleOptions, "relevance", -1.0),
        (MemoryBudget, "share", 1.5),
        (MemoryBudget, "least", 0),
        (MemoryBudget, "bytes", 0),
        (WorkingSize, "cells", 0),
        (WorkingSize, "patches", -480),
        (RefreshOptions, "looks", 0),
        (RefreshOptions, "novel", -1.0),
        (RefreshOptions, "most_novel", 1.01),
        (SarsOptions, "radius", -0.1),
        (SarsOptions, "rotation_weight", math.inf),
    ],
)
def test_a_number_out_of_range_is_refused_by_name(
    kind: type[Any], field: str, value: float
) -> None:
    with pytest.raises(
        InputError, match=rf"{kind.__name__}\.{field} is {value}; it is"
    ):
        kind(**{field: value})


@pytest.mark.parametrize(
    ("memory", "budget"),
    [
        (None, MemoryBudget(least=FEW_KEYFRAMES)),
        ("25 %", MemoryBudget(share=0.25)),
        ("5MB", MemoryBudget(bytes=5_000_000)),
        ("0.5KiB", MemoryBudget(bytes=512)),
        ("100000", MemoryBudget(bytes=100_000)),
        ("Auto", MemoryBudget(auto=True)),
        (20, MemoryBudget(share=0.0, least=20)),
    ],
)
def test_a_budget_is_read(memory: str | int | None, budget: MemoryBudget) -> None:
    assert MemoryBudget.parse(memory) == budget


@pytest.mark.parametrize("memory", ["0%", "101%", "5 apples", "0.1", "", 0])
def test_a_budget_of_nothing_is_refused(memory: str | int) -> None:
    with pytest.raises(InputError):
        MemoryBudget.parse(memory)


@pytest.mark.parametrize(("memory", "kept"), [(1, 1), (20, 20), (31, 30), ("10%", 3)])
def test_an_int_is_a_number_of_keyframes(
    memory: str | int, kept: int, rooms: tuple[Recording, ...]
) -> None:
    assert MemoryBudget.parse(memory).capacity(rooms[0].train, 48) == kept
