"""Guided matching: a pose of little support is looked for again near where it was found."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from evercal.geometry import SE3, pose_distance
from evercal.localization.localizer import LocalizeOptions, Localizer
from evercal.localization.query import Candidate, Hypothesis, Query
from evercal.mapping.scene_maps import SceneMaps
from evercal.recordings import Recording

KEYFRAMES = Candidate(0, np.arange(3), 2)


def with_support(support: float, metres: float = 0.0) -> Hypothesis:
    """Nine landmarks of nine are found: the support is the share to the power 1.5, times 3."""
    share = (support / 3) ** (2 / 3)
    place = SE3.exp([metres, 0, 0, 0, 0, 0])
    return Hypothesis(0, place, np.eye(6), 9, share, aligned=True, matched=9, planned=9)


@pytest.mark.parametrize(
    ("first", "later", "end", "looks"),
    [
        (0.5, [1.0, 1.05], 1.0, 2),  # until the gain is small
        (0.5, [0.4], 0.5, 1),
        (0.5, [1.0, 1.6, 9.0], 1.6, 2),  # until it is clear
        (1.5, [], 1.5, 0),
        (0.0, [], 0.0, 0),
    ],
)
def test_it_is_looked_at_as_long_as_that_helps(
    first: float, later: list[float], end: float, looks: int
) -> None:
    localizer: Any = Localizer.__new__(Localizer)
    localizer.options = LocalizeOptions()
    asked: list[tuple[int, SE3]] = []

    def hypothesis(query: Query, candidate: Candidate, cameras: object, near: SE3) -> Hypothesis:
        asked.append((candidate.match_stride, near))
        return with_support(later[len(asked) - 1], float(len(asked)))

    localizer._hypothesis = hypothesis
    start = with_support(first) if first else replace(with_support(1.0), inliers=0)
    found = localizer._guided(None, start, KEYFRAMES, [])
    assert found.support == pytest.approx(end)
    assert [stride for stride, _ in asked] == [1] * looks
    places = [near.translation_m[0] for _, near in asked]
    assert np.allclose(places, range(looks))


@pytest.fixture(scope="module")
def asked(hall: Recording, hall_maps: SceneMaps) -> tuple[Localizer, Query, Any, SE3]:
    """A localizer, an image on its way, its camera and its pose."""
    frame, localizer = hall.test[7], Localizer(hall_maps)
    image, truth = frame.read_image(), frame.base_from_camera
    assert truth is not None
    features = localizer._encode([localizer._prepare(image, frame.camera)])[0]
    return localizer, Query(image, features, 480), frame.camera, truth


def test_patches_are_matched_to_what_they_would_show_nearby(
    asked: tuple[Localizer, Query, Any, SE3],
) -> None:
    localizer, query, camera, truth = asked

    def away(near: SE3 | None) -> np.ndarray:
        pixels, points, cells = localizer._matcher.correspondences(query, KEYFRAMES, camera, near)
        assert len(pixels) == len(points) <= cells
        assert np.isfinite(points).all()
        return np.linalg.norm(camera.project(truth.inverse().apply(points)) - pixels, axis=1)

    near, anywhere = away(truth), away(None)
    assert near.max() < LocalizeOptions().guided_px < anywhere.max()
    assert (near < 4).sum() >= (anywhere < 4).sum()
    behind = truth @ SE3.exp([0, 0, 0, 0, np.pi, 0])
    pixels, points, _ = localizer._matcher.correspondences(query, KEYFRAMES, camera, behind)
    assert len(pixels) == len(points) < 0.5 * len(near)


def test_a_pose_beside_the_true_one_leads_to_it(
    asked: tuple[Localizer, Query, Any, SE3],
) -> None:
    localizer, query, camera, truth = asked
    beside = truth @ SE3.exp([0.1, 0.05, 0, 0, 0.03, 0])
    wrong = replace(with_support(0.3), pose=beside)
    found = localizer._guided(query, wrong, KEYFRAMES, [camera])
    assert found.pose is not None
    assert pose_distance(found.pose, truth)[0] < 0.01 < pose_distance(beside, truth)[0]


def test_little_support_widens_the_covariance() -> None:
    assert with_support(1.0).doubt == pytest.approx(4.0)
    assert with_support(2.0).doubt == pytest.approx(2.0)
    assert replace(with_support(4.0), planned=900).doubt == 1.0
    assert Hypothesis(0, SE3.identity(), np.eye(6), 9, 0.1).doubt == 1.0
