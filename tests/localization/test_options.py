"""Options out of range are refused by name."""

from __future__ import annotations

from typing import Any

import pytest

from evercal.errors import InputError
from evercal.localization.alignment import AlignmentOptions, AlignmentRound
from evercal.localization.options import Attempt, LocalizeOptions
from evercal.localization.pnp import PnpOptions
from evercal.localization.tracking import TrackOptions


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        (LocalizeOptions, {"keyframes": 0}),
        (LocalizeOptions, {"candidates": 0}),
        (LocalizeOptions, {"votes": 1.5}),
        (LocalizeOptions, {"attempts": ()}),
        (LocalizeOptions, {"attempts": (Attempt(12, 4), Attempt(0, 4))}),
        (LocalizeOptions, {"attempts": (Attempt(12, 4, when="never"),)}),  # pyright: ignore[reportArgumentType]
        (TrackOptions, {"checked": 0}),
        (TrackOptions, {"at_most_ms": -1.0}),
        (PnpOptions, {"max_iterations": 0}),
        (AlignmentOptions, {"min_matches": 0}),
        (AlignmentOptions, {"rounds": ()}),
        (AlignmentOptions, {"rounds": (AlignmentRound(2, 1, 1, 1, 1.0),) * 2}),
    ],
)
def test_options_out_of_range_are_refused(
    kind: type[Any], values: dict[str, Any]
) -> None:
    with pytest.raises(InputError, match=r"(Options|Attempt|Round)\.\w+ "):
        kind(**values)
