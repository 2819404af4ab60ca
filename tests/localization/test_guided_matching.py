"""Guided matching: an image is matched again near a pose with little support."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from evercal.features.encode import encode_image

from evercal.geometry import SE3, UncertainPose, pose_distance
from evercal.localization.acceptance import support
from evercal.localization.intrinsics import OWN
from evercal.localization.localizer import Localizer
from evercal.localization.query import Candidate, Hypothesis, LocalizeOptions, Query
from evercal.mapping.scene_map import MapContents
from evercal.recordings import Frame, Recording

KEYFRAMES = Candidate(0, np.arange(3), 2)


def with_support(value: float, x_m: float = 0.0) -> Hypothesis:
    """A pose with a given support: all of n landmarks are inliers, so it is sqrt(planned)."""
    points = np.zeros((9, 3))
    inliers = points if value else points[:0]
    pose = UncertainPose(SE3.exp([x_m, 0, 0, 0, 0, 0]), np.eye(6))
    # 9 of 9 matches are inliers, a share r of the landmarks: r^1.5 * sqrt(900) = value.
    expected = 9 / (value / 30) ** (2 / 3) if value else 0
    return Hypothesis(0, pose, None, inliers[:, :2], inliers, expected, 9, 900)  # type: ignore[arg-type]


@dataclass
class Scripted(Localizer):
    """A localizer whose hypotheses have a given support, one after another."""

    supports: list[float]
    near: list[float] = field(default_factory=list)
    strides: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.options = LocalizeOptions()

    def _hypothesis(
        self,
        query: object,
        candidate: Candidate,
        camera: object,
        near: Hypothesis | None = None,
        matches: object = None,
    ) -> Hypothesis:
        if near is not None:
            assert near.pose is not None
            self.near.append(float(near.pose.pose.translation_m[0]))
            self.strides.append(candidate.match_stride)
        number = len(self.near)
        return with_support(self.supports[min(number, len(self.supports) - 1)], float(number))


@pytest.mark.parametrize(
    ("supports", "best", "rounds"),
    [
        ([0.5, 1.0, 1.05], 1.0, 2),
        ([0.5, 0.4], 0.5, 1),
        ([0.5, 1.0, 1.6, 9.0], 1.6, 2),
        ([1.5], 1.5, 0),
        ([0.0], 0.0, 0),
        ([0.5, 0.5, 0.5], 0.5, 1),
    ],
)
def test_rounds_repeat_while_the_support_rises(
    supports: list[float], best: float, rounds: int
) -> None:
    localizer = Scripted(supports)
    hypothesis = localizer._guided(None, KEYFRAMES, None)  # type: ignore[arg-type]
    assert support(hypothesis) == pytest.approx(best)
    assert localizer.near == list(range(rounds))
    assert localizer.strides == [1] * rounds


@pytest.fixture(scope="module")
def localizer(hall_map: MapContents) -> Localizer:
    return Localizer(hall_map)


@pytest.fixture(scope="module")
def frame(hall: Recording) -> Frame:
    return hall.test[7]


@pytest.fixture(scope="module")
def query(hall_map: MapContents, frame: Frame) -> Query:
    image = frame.read_image()
    return Query(image, encode_image(image, hall_map.encoder, 240), 480, [OWN])


def truth_of(frame: Frame) -> SE3:
    assert frame.base_from_camera is not None
    return frame.base_from_camera


def test_matches_project_near_their_pixels(
    localizer: Localizer, query: Query, frame: Frame
) -> None:
    camera, truth = frame.camera, truth_of(frame)

    def distances(near: SE3 | None) -> np.ndarray:
        matches = localizer._matcher.matches(query, KEYFRAMES, camera, near)
        assert np.isfinite(matches.points_m).all()
        projected = camera.project(truth.inverse().apply(matches.points_m))
        return np.linalg.norm(projected - matches.pixels, axis=1)

    near, anywhere = distances(truth), distances(None)
    assert near.max() < LocalizeOptions().guided_px < np.nanmax(anywhere)
    assert (near < 4).sum() >= (anywhere < 4).sum()
    behind = truth @ SE3.exp([0, 0, 0, 0, np.pi, 0])
    assert len(localizer._matcher.matches(query, KEYFRAMES, camera, behind).pixels) < 0.5 * len(
        near
    )


def with_pose(pose: SE3) -> Hypothesis:
    return Hypothesis(0, UncertainPose(pose, np.eye(6)))


def test_a_pose_beside_the_true_one_converges(
    localizer: Localizer, query: Query, frame: Frame
) -> None:
    truth = truth_of(frame)
    beside = truth @ SE3.exp([0.1, 0.05, 0, 0, 0.03, 0])
    dense = replace(KEYFRAMES, match_stride=1)
    hypothesis = localizer._hypothesis(query, dense, frame.camera, with_pose(beside))
    assert hypothesis.pose is not None
    estimate = localizer.contents.scenes[0].frame.to_base(hypothesis.pose)
    assert pose_distance(estimate.pose, truth)[0] < 0.01 < pose_distance(beside, truth)[0]
