"""Repeated texture: steps of patterns, poses that slipped, ambiguous images."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from evercal.geometry import UncertainPose, pose_distance
from evercal.localization import rivals
from evercal.localization.hypothesis import NO_MATCHES, Aligned
from evercal.localization.localizer import Localizer
from evercal.localization.query import Query
from evercal.localization.repetition import displaced, pattern_steps
from evercal.localization.scene_poses import ScenePoses
from evercal.mapping.scene_map import MapContents
from evercal.recordings.frame import Recording

STEP_M = 0.1


def grid(rng: np.random.Generator, alike: bool) -> tuple[np.ndarray, np.ndarray]:
    """A wall of 8x8 landmarks before single ones, and their patches."""
    across = STEP_M * np.stack(
        np.meshgrid(np.arange(8), np.arange(8), [0]), -1
    ).reshape(-1, 3)
    points = np.concatenate(
        [across + rng.normal(0, 2e-4, across.shape), rng.normal(size=(60, 3))]
    )
    patches = rng.normal(size=(len(points), 121))
    if alike:
        patches[:64] = patches[0] + 0.1 * patches[:64]
    patches -= patches.mean(1, keepdims=True)
    return points, patches / patches.std(1, keepdims=True)


def test_steps_of_a_pattern_are_found() -> None:
    points, patches = grid(np.random.default_rng(0), alike=True)
    steps = pattern_steps(points, patches, np.array([0.0, 0.0, -1.0]))
    for step in (np.eye(3)[0], -np.eye(3)[0], np.eye(3)[1], -np.eye(3)[1]):
        assert np.linalg.norm(steps - STEP_M * step, axis=1).min() < 1e-3
    whole = np.round(steps / STEP_M)
    np.testing.assert_allclose(steps, STEP_M * whole, atol=1e-3)


def test_landmarks_that_differ_have_no_pattern() -> None:
    points, patches = grid(np.random.default_rng(0), alike=False)
    assert pattern_steps(points, patches, np.array([0.0, 0.0, -1.0])).shape == (0, 3)
    assert pattern_steps(points[:0], patches[:0], np.zeros(3)).shape == (0, 3)


class _WithRival(Localizer):
    """Replaces the first pose by one that slipped, and proposes the true one."""

    weaker: float
    """Landmarks that the slipped pose expects, relative to the true one."""

    def _best_hypothesis(self, query: Query) -> Aligned:
        true = super()._best_hypothesis(query)
        assert isinstance(true, Aligned)
        self.true = replace(true, matches=NO_MATCHES)
        return self._slipped()

    def _slipped(self) -> Aligned:
        pose = UncertainPose(
            displaced(self.true.pose.pose, np.array([0.03, 0, 0])),
            self.true.pose.covariance,
        )
        expected = round(self.weaker * self.true.expected)
        return replace(self.true, pose=pose, expected=expected)

    def rivals(self, _: ScenePoses, __: Query, best: Aligned) -> Iterator[Aligned]:
        yield self._slipped() if best is self.true else self.true


@pytest.mark.parametrize(
    ("weaker", "status"), [(2.0, "ok"), (1.05, "ambiguous"), (1.0, "ambiguous")]
)
def test_a_clearly_stronger_pose_wins(
    weaker: float,
    status: str,
    hall: Recording,
    hall_map: MapContents,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    localizer = _WithRival(hall_map)
    monkeypatch.setattr(rivals, "_rivals", localizer.rivals)
    frame = hall.test[5]
    localizer.weaker = weaker
    truth = frame.base_from_camera
    assert truth is not None
    estimate = localizer.localize(frame.read_image())
    assert estimate.status == status
    if estimate.base_from_camera is not None:
        assert pose_distance(estimate.base_from_camera, truth)[0] < 0.005
        return
    assert "mm" in estimate.reason
    assert len(estimate.alternatives) == 2
    distances = sorted(
        float(pose_distance(pose, truth)[0]) for pose in estimate.alternatives
    )
    np.testing.assert_allclose(distances, [0, 0.03], atol=0.005)


def test_an_image_of_two_places_is_not_located_in_one(
    hall: Recording, hall_map: MapContents
) -> None:
    localizer = Localizer(hall_map)
    first = hall.test[2]
    second = hall.test[14]
    image = first.read_image().copy()
    other = second.read_image()
    image[:, 160:] = other[:, 160:]
    estimate = localizer.localize(image)
    assert estimate.status == "ambiguous"
    truths = [
        f.base_from_camera for f in (first, second) if f.base_from_camera is not None
    ]
    near, far = sorted(
        estimate.alternatives, key=lambda pose: pose_distance(pose, truths[0])[0]
    )
    for truth, pose in zip(truths, (near, far), strict=True):
        assert pose_distance(pose, truth)[0] < 0.02
