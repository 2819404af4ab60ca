"""Coverage of rotations with known spread, and images that are bad in a known way."""

import cv2
import numpy as np
import pytest

from evercal.geometry import SE3
from evercal.live.coverage import Sample, clipped_share, coverage, sharpness
from evercal.simulation.textures import dead_leaves


def samples(tangents: np.ndarray) -> list[Sample]:
    poses = SE3.exp(tangents)
    return [Sample(f"{i:02d}", pose, 0.7, 0.0) for i, pose in enumerate(poses)]


def turned(count: int, spread_deg: tuple[float, float, float]) -> np.ndarray:
    tangents = np.random.default_rng(0).normal(size=(count, 6))
    return tangents * [0.05, 0.05, 0.05, *np.deg2rad(spread_deg)]


@pytest.mark.parametrize(
    ("spread_deg", "rank"),
    [((0, 0, 0), 0), ((20, 0, 0), 1), ((20, 0, 20), 2), ((20, 20, 20), 3)],
)
def test_rank_counts_axes_of_rotation(
    spread_deg: tuple[float, float, float], rank: int
) -> None:
    found = coverage(samples(turned(30, spread_deg)))
    assert found.rotation_rank == rank
    assert [axis.covered for axis in found.rotations] == [
        spread > 0 for spread in spread_deg
    ]
    assert found.ready == (rank >= 2)
    for axis, spread in zip(found.rotations, spread_deg, strict=True):
        assert axis.spread == pytest.approx(spread, rel=0.35, abs=3.0)


def test_axes_are_those_of_the_camera_if_its_mount_is_known() -> None:
    mount = SE3.exp(np.array([0, 0, 0, 0, np.pi / 2, 0]))  # camera z is gripper x
    found = coverage(samples(turned(30, (20, 0, 0))), mount)
    assert [axis.covered for axis in found.rotations] == [False, False, True]
    assert "camera's x axis" in found.verdict
    assert any("y axis" in words for words in found.missing)


def test_bad_samples_are_named_and_do_not_count() -> None:
    good = samples(turned(26, (20, 20, 20)))
    twin = Sample("twin", good[4].base_from_gripper, 0.7, 0.0)
    blurred = Sample("blurred", SE3.exp(np.full(6, 0.4)), 0.3, 0.0)
    dark = Sample("dark", SE3.exp(np.full(6, -0.4)), 0.7, 0.6)
    found = coverage([*good, twin, blurred, dark])
    problems = {row.name: row.problems for row in found.samples if row.problems}
    assert problems.keys() == {"twin", "blurred", "dark"}
    assert "same pose as 04" in problems["twin"][0]
    assert "26 of 29" in found.verdict
    assert coverage(good).missing == found.missing == ()


def test_an_empty_recording_is_not_ready() -> None:
    found = coverage([])
    assert (found.samples, found.ready, found.rotation_rank) == ((), False, 0)
    assert "8 more images" in found.missing[0]


def test_sharpness_falls_with_blur_in_any_direction_and_not_with_contrast() -> None:
    rng = np.random.default_rng(2)
    image = dead_leaves(320, 320, rng, 120).astype(np.uint8)
    sharp = sharpness(image)
    for kernel in (np.ones((1, 9)), np.ones((9, 1)), np.eye(9)):
        blurred = np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum()), np.uint8)
        assert sharpness(blurred) < 0.7 * sharp
    pale = (100 + 0.4 * image.astype(float)).astype(np.uint8)
    assert sharpness(pale) == pytest.approx(sharp, rel=0.05)
    assert sharpness(np.full((64, 64, 3), 7, np.uint8)) == 0.0


def test_clipped_share_counts_black_and_white() -> None:
    image = np.full((10, 10, 3), 100, np.uint8)
    image[:2] = 255
    image[2:3] = 0
    image[5, :, 0] = 255  # red, not white
    assert clipped_share(image) == pytest.approx(0.3)
