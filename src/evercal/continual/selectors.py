"""Which frames of a finished scene stay, by name: the rules of `mapping` and of the features."""

from collections.abc import Callable

import numpy as np

from evercal.continual.frame_statistics import FrameStatistics
from evercal.continual.selection_by_features import (
    select_coverage,
    select_gradients,
    select_herding,
    select_hybrid,
    select_leverage,
    select_reservoir,
)
from evercal.mapping.selection import SarsOptions, select_sars

Select = Callable[[FrameStatistics, int], np.ndarray]
"""(frames of a finished scene, capacity) -> indices of those that stay, in recorded order."""


def _sars(frames: FrameStatistics, capacity: int) -> np.ndarray:
    return select_sars(frames.positions_m, frames.quaternions_wxyz, capacity, SarsOptions())


def _sars_filled(frames: FrameStatistics, capacity: int) -> np.ndarray:
    fill = SarsOptions(fill=True)
    return select_sars(frames.positions_m, frames.quaternions_wxyz, capacity, fill)


def _reservoir(frames: FrameStatistics, capacity: int) -> np.ndarray:
    return select_reservoir(len(frames), capacity, frames.rng())


def _hybrid(frames: FrameStatistics, capacity: int) -> np.ndarray:
    return select_hybrid(frames.features(), capacity, frames.rng())


def _herding(frames: FrameStatistics, capacity: int) -> np.ndarray:
    return select_herding(frames.features(), capacity)


def _leverage(frames: FrameStatistics, capacity: int) -> np.ndarray:
    return select_leverage(frames.features(), capacity, frames.rng())


def _coverage(frames: FrameStatistics, capacity: int) -> np.ndarray:
    return select_coverage(frames.visible_parts(), capacity, frames.rng())


def _coverage_redundant(frames: FrameStatistics, capacity: int) -> np.ndarray:
    return select_coverage(frames.visible_parts(), capacity, frames.rng(), "redundant")


def _gradients(frames: FrameStatistics, capacity: int) -> np.ndarray:
    return select_gradients(frames.gradients(), capacity, frames.rng())


SELECTORS: dict[str, Select] = {
    "reservoir": _reservoir,
    "hybrid": _hybrid,
    "herding": _herding,
    "coverage": _coverage,
    "coverage_redundant": _coverage_redundant,
    "leverage": _leverage,
    "gradients": _gradients,
    "sars": _sars,
    "sars_filled": _sars_filled,
}
"""`sars` keeps the paper's fixed radius, `sars_filled` takes the largest that fills the memory."""
