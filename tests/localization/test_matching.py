"""Matches of an image to the keyframes of a map, its quarter turn, and poses aligned from them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evercal.geometry import SE3, pose_distance
from evercal.localization.intrinsics import OWN, cameras_in_scenes
from evercal.localization.localizer import Localizer
from evercal.localization.matching import turned
from evercal.localization.options import Attempt, LocalizeOptions
from evercal.localization.query import Candidate, Encoded, Query
from evercal.mapping.scene_map import MapContents
from evercal.recordings import Frame, Recording

KEYFRAMES = Candidate(0, np.arange(3), 2)


@pytest.fixture(scope="module")
def localizer(hall_map: MapContents) -> Localizer:
    return Localizer(hall_map)


@pytest.fixture(scope="module")
def frame(hall: Recording) -> Frame:
    return hall.test[7]


def truth_of(frame: Frame) -> SE3:
    assert frame.base_from_camera is not None
    return frame.base_from_camera


def query_of(image: np.ndarray, contents: MapContents) -> Query:
    encoded = Encoded(contents.encoder.encode(image, 240))
    cameras = cameras_in_scenes(None, image, contents.scenes)
    return Query(image, 480, cameras, [OWN], encoded)


def test_matches_are_the_most_similar_cells_of_all_keyframes(
    localizer: Localizer, frame: Frame, hall_map: MapContents
) -> None:
    query = query_of(frame.read_image(), hall_map)
    matches = localizer.poses.matcher.matches(query, KEYFRAMES, frame.camera)
    loaded = [localizer.poses.bank.load(int(k)).cells for k in KEYFRAMES.keyframes]
    features = np.concatenate([cells.features for cells in loaded])
    points = np.concatenate([cells.points_m for cells in loaded])
    rows, columns = query.encoded.features.shape[:2]
    spots = [(i, j) for i in range(0, rows, 2) for j in range(0, columns, 2)]
    similar = np.array([features @ query.encoded.features[i, j] for i, j in spots])
    order = np.argsort(-similar.max(1), kind="stable")  # the most similar first
    nearest = similar.argmax(1)
    pixels = np.array([(8 * j + 3.5, 8 * i + 3.5) for i, j in spots])
    same = (matches.points_m == points[nearest[order]]).all(1)
    same &= (matches.pixels == pixels[order]).all(1)
    assert np.mean(same) > 0.98  # equal to rounding
    projected = frame.camera.project(truth_of(frame).inverse().apply(matches.points_m))
    off = np.linalg.norm(projected - matches.pixels, axis=1)
    assert (off < 8).mean() > 0.5


def test_similarities_are_calculated_once(
    localizer: Localizer, frame: Frame, hall_map: MapContents
) -> None:
    query = query_of(frame.read_image(), hall_map)
    attempt = Attempt(7, 4)
    (candidate,) = localizer.poses.matcher.candidates(query, attempt)
    assert set(query.encoded.nearest) == {(4, k) for k in range(7)}
    known = dict(query.encoded.nearest)
    again = query_of(frame.read_image(), hall_map)
    one, other = (
        localizer.poses.matcher.matches(q, candidate, frame.camera)
        for q in (query, again)
    )
    assert query.encoded.nearest == known
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)


def test_every_patch_is_matched_before_a_repeated_pattern(
    localizer: Localizer,
    frame: Frame,
    hall_map: MapContents,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(localizer.poses.bank, "pattern", lambda _: np.eye(3))
    query = query_of(frame.read_image(), hall_map)
    (candidate,) = localizer.poses.matcher.candidates(query, Attempt(7, 4))
    assert candidate.stride == 1


@pytest.mark.parametrize("turns", range(4))
def test_quarter_turns_are_recognised(
    turns: int, localizer: Localizer, hall: Recording, hall_map: MapContents
) -> None:
    for frame in hall.test[1::6]:
        query = query_of(turned(frame.read_image(), turns), hall_map)
        upright = localizer.poses.matcher.upright(query)
        assert upright.turns == -turns % 4
        assert upright is query.encoded or not upright.nearest
        expected = hall_map.encoder.encode(frame.read_image(), 240)
        np.testing.assert_allclose(upright.features, expected, atol=1e-4)


@pytest.mark.parametrize("scale", [1.0, 1.6])
def test_matches_of_a_magnified_image_are_at_the_same_places(
    scale: float, localizer: Localizer, frame: Frame, hall_map: MapContents
) -> None:
    query = query_of(frame.read_image(), hall_map)
    query = replace(query, encoded=localizer.poses.matcher.magnified(query, scale))
    assert query.encoded.features.shape[:2] == (round(30 * scale), round(40 * scale))
    matches = localizer.poses.matcher.matches(query, KEYFRAMES, frame.camera)
    projected = frame.camera.project(truth_of(frame).inverse().apply(matches.points_m))
    off = np.linalg.norm(projected - matches.pixels, axis=1)
    assert (off < 8).mean() > 0.3


def test_noise_is_no_turned_image(
    localizer: Localizer, frame: Frame, hall_map: MapContents
) -> None:
    image = frame.read_image().copy()
    rng = np.random.default_rng(0)
    image[:, 80:] = rng.integers(0, 256, image[:, 80:].shape)
    assert localizer.poses.matcher.upright(query_of(image, hall_map)).turns == 0


def test_a_pose_beside_the_true_one_converges(
    localizer: Localizer, frame: Frame, hall_map: MapContents
) -> None:
    truth = truth_of(frame)
    query = query_of(frame.read_image(), hall_map)
    beside = truth @ SE3.exp([0.04, 0.02, 0, 0, 0.01, 0])
    (candidate,) = localizer.poses.matcher.candidates(query, Attempt(7, 4))
    found = localizer.poses.aligned(query, candidate, beside, np.zeros(5))
    assert found is not None
    assert (
        pose_distance(found.pose.pose, truth)[0]
        < 0.01
        < pose_distance(beside, truth)[0]
    )


def test_a_pose_of_little_support_is_aligned_to_the_keyframes_that_see_its_view(
    hall_map: MapContents, frame: Frame
) -> None:
    localizer = Localizer(hall_map, LocalizeOptions(keyframes=2, immediate=99))
    truth = truth_of(frame)
    query = query_of(frame.read_image(), hall_map)
    ranked = localizer.poses.bank.seen(0, truth, frame.camera)
    supports = []
    for chosen in (ranked[-2:], ranked[:2]):
        candidate = Candidate(0, chosen)
        found = localizer.poses.aligned(query, candidate, truth, np.zeros(5))
        assert found is not None
        supports.append(found.support)
        best = localizer.poses.reselected(query, found)
        assert set(best.candidate.keyframes) == set(ranked[:2])
    assert supports[0] < supports[1]
