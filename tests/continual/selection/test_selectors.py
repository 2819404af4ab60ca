"""All selectors: capacity and order."""

import numpy as np
import pytest

from evercal.continual.networks.buffer import FeatureBuffer
from evercal.continual.networks.head import Head, HeadOptions
from evercal.continual.selection.frame_statistics import FrameStatistics
from evercal.continual.selection.selectors import SELECTORS
from evercal.geometry import SE3, Camera
from evercal.mapping.selection import UNITS
from evercal.recordings.frame import Frame


class SyntheticFrames(FrameStatistics):
    """Frames of a moving camera, with synthetic outputs of a head."""

    def __init__(self, positions: np.ndarray, quaternions: np.ndarray):
        camera = Camera(8, 8, 8, 8, 3.5, 3.5)
        image = np.zeros((8, 8, 3), np.uint8)
        frames = [
            Frame(f"{i}", image, camera, SE3(quaternions[i], positions[i]))
            for i in range(len(positions))
        ]
        head = Head(4, 4, HeadOptions(width=4))
        super().__init__(frames, head, lambda: FeatureBuffer(0, SE3.identity()), 0)
        self._made_up = np.random.default_rng(7).normal(size=(len(positions), 40))

    def features(self) -> np.ndarray:
        return self._made_up

    def gradients(self) -> np.ndarray:
        return self._made_up

    def visible_parts(self) -> list[np.ndarray]:
        return [np.flatnonzero(row > 1) for row in self._made_up]


@pytest.mark.parametrize("count", [10, 37, 100, 256])
@pytest.mark.parametrize("name", SELECTORS)
def test_selection_is_sorted_and_within_capacity(name: str, count: int) -> None:
    rng = np.random.default_rng(count)
    positions = np.cumsum(rng.normal(0, 0.05, (count, 3)), axis=0)
    rotations = np.array([1.0, 0, 0, 0]) + np.cumsum(
        rng.normal(0, 0.1, (count, 4)), axis=0
    )
    quaternions = rotations / np.linalg.norm(rotations, axis=1, keepdims=True)
    capacity = count // 10
    selected = SELECTORS[name](SyntheticFrames(positions, quaternions), capacity)
    assert 1 <= len(selected) <= capacity
    assert np.issubdtype(selected.dtype, np.integer)
    assert (np.diff(selected) > 0).all()
    assert selected[0] >= 0
    assert selected[-1] < count


def test_only_sars_may_leave_memory_unused() -> None:
    # On a straight path few frames are 0.5 apart.
    positions = np.linspace(0, 1, 200)[:, None] * [1.0, 0, 0]
    quaternions = np.tile([1.0, 0, 0, 0], (200, 1))
    selected = {
        name: len(rule(SyntheticFrames(positions, quaternions), 20))
        for name, rule in SELECTORS.items()
    }
    fixed = {"sars", *(f"sars_{unit}" for unit in UNITS)}
    for name in fixed - {"sars_deviation"}:
        assert selected[name] < 20
    assert {selected[name] for name in selected.keys() - fixed} == {20}
