"""Rules that select keyframes, by name."""

from collections.abc import Callable

import numpy as np

from evercal.continual.selection.frame_statistics import FrameStatistics
from evercal.continual.selection.selection_by_features import (
    select_coverage,
    select_gradients,
    select_herding,
    select_leverage,
    select_reservoir,
)
from evercal.mapping.selection import SarsOptions, select_sars

Select = Callable[[FrameStatistics, int], np.ndarray]
"""Maps the frames of a finished scene and a capacity to sorted indices of the keyframes."""

SELECTORS: dict[str, Select] = {
    "reservoir": lambda f, capacity: select_reservoir(len(f), capacity, f.rng()),
    "herding": lambda f, capacity: select_herding(f.features(), capacity),
    "coverage": lambda f, capacity: select_coverage(f.visible_parts(), capacity, f.rng()),
    "leverage": lambda f, capacity: select_leverage(f.features(), capacity, f.rng()),
    "gradients": lambda f, capacity: select_gradients(f.gradients(), capacity, f.rng()),
    "sars": lambda f, capacity: select_sars(f.positions_m, f.quaternions_wxyz, capacity),
    "sars_filled": lambda f, capacity: select_sars(
        f.positions_m, f.quaternions_wxyz, capacity, SarsOptions(fill=True)
    ),
}
"""`sars` uses the paper's fixed radius, `sars_filled` the largest radius that fills the memory."""
