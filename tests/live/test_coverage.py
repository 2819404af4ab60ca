"""Coverage of rotations with known spread, and images that are bad in a known way."""

from typing import Any

import cv2
import numpy as np
import pytest

from evercal.geometry import SE3
from evercal.live.coverage import Sample, clipped_share, coverage, sharpness
from evercal.simulation.textures import dead_leaves


def samples(tangents):
    poses = SE3.exp(tangents)
    return [Sample(f"{i:02d}", pose, 0.7, 0.0) for i, pose in enumerate(poses)]


def turned(count, spread_deg):
    tangents = np.random.default_rng(0).normal(size=(count, 6))
    return tangents * [0.05, 0.05, 0.05, *np.deg2rad(spread_deg)]


@pytest.mark.parametrize(
    ("spread_deg", "rank"),
    [((0, 0, 0), 0), ((20, 0, 0), 1), ((20, 0, 20), 2), ((20, 20, 20), 3)],
)
def test_rank_counts_axes_of_rotation(spread_deg, rank):
    covered = coverage(samples(turned(30, spread_deg)))
    assert (covered.rotation_rank, covered.ready) == (rank, rank >= 2)
    for axis, spread in zip(covered.rotations, spread_deg, strict=True):
        assert axis.covered == (spread > 0)
        assert axis.spread == pytest.approx(spread, rel=0.35, abs=3.0)


def test_axes_are_those_of_the_camera_if_its_mount_is_known():
    mount = SE3.exp([0, 0, 0, 0, np.pi / 2, 0])  # camera z is gripper x
    covered = coverage(samples(turned(30, (20, 0, 0))), mount)
    assert [axis.covered for axis in covered.rotations] == [False, False, True]
    assert "camera's x axis" in covered.verdict
    assert "y axis" in str(covered.missing)


def test_bad_samples_are_named_and_do_not_count():
    good = samples(turned(26, (20, 20, 20)))
    twin = Sample("twin", good[4].base_from_gripper, 0.7, 0.0)
    blurred = Sample("blurred", SE3.exp([0.4] * 6), 0.3, 0.0)
    dark = Sample("dark", SE3.exp([-0.4] * 6), 0.7, 0.6)
    covered = coverage([*good, twin, blurred, dark])
    bad = [row for row in covered.samples if row.problems]
    assert [row.name for row in bad] == ["twin", "blurred", "dark"]
    assert "same pose as 04" in bad[0].problems[0]
    assert "26 of 29" in covered.verdict
    assert coverage(good).missing == covered.missing == ()


def test_an_empty_recording_is_not_ready():
    covered = coverage([])
    assert (covered.samples, covered.ready, covered.rotation_rank) == ((), False, 0)
    assert "8 more images" in covered.missing[0]


def test_sharpness_falls_with_blur_in_any_direction_and_not_with_contrast():
    rng = np.random.default_rng(2)
    image = dead_leaves(320, 320, rng, 120).astype(np.uint8)
    sharp = sharpness(image)
    for kernel in (np.ones((1, 9)), np.ones((9, 1)), np.eye(9)):
        blurred: Any = cv2.filter2D(image, -1, kernel / kernel.sum())
        assert sharpness(blurred) < 0.7 * sharp
    pale = (100 + 0.4 * image).astype(np.uint8)
    assert sharpness(pale) == pytest.approx(sharp, rel=0.05)
    assert sharpness(np.full((64, 64, 3), 7, np.uint8)) == 0.0


def test_clipped_share_counts_black_and_white():
    image = np.full((10, 10, 3), 100, np.uint8)
    image[:2] = 255
    image[2:3] = 0
    image[5, :, 0] = 255  # red, not white
    assert clipped_share(image) == pytest.approx(0.3)
