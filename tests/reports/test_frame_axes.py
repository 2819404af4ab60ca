"""Axes of a frame are drawn at the pixels that independent formulas give."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from evercal.geometry import SE3, Camera
from evercal.reports.frame_axes import axes_in_view, close_up, draw_axes, draw_directions


def pose(quaternion: ArrayLike, translation: ArrayLike) -> SE3:
    return SE3(np.array(quaternion, np.float64), np.array(translation, np.float64))


PINHOLE = Camera(640, 480, 600.0, 610.0, 320.0, 240.0)
DISTORTED = Camera(640, 480, 600.0, 610.0, 320.0, 240.0, (-0.3, 0.1, 0.001, -0.002, 0.01))
AHEAD = SE3.exp([0.05, -0.02, 1.0, 0.3, -0.4, 0.2])
GREY = np.full((480, 640, 3), 128, np.uint8)


@settings(max_examples=50)
@given(seed=st.integers(0, 10_000), camera=st.sampled_from([PINHOLE, DISTORTED]))
def test_projections_agree_with_opencv(seed: int, camera: Camera) -> None:
    rng = np.random.default_rng(seed)
    camera_from_frame = pose(
        rng.normal(0, 1, 4), [*rng.uniform(-0.2, 0.2, 2), rng.uniform(0.8, 2.0)]
    )
    axes = axes_in_view(camera, camera_from_frame, 0.1)
    corners = np.vstack([np.zeros(3), 0.1 * np.eye(3)])
    rotation, _ = cv2.Rodrigues(camera_from_frame.rotation_matrix())
    distortion = np.array(camera.distortion or (0.0,) * 4)
    expected, _ = cv2.projectPoints(
        corners, rotation, camera_from_frame.translation_m, camera.matrix(), distortion
    )
    assert axes.origin_px == pytest.approx(expected[0, 0], abs=1e-6)
    for line, end in zip(axes.lines, expected[1:, 0], strict=True):
        assert line[0] == pytest.approx(expected[0, 0], abs=1e-6)
        assert line[-1] == pytest.approx(end, abs=1e-6)


def test_axes_of_a_base_below_the_camera() -> None:
    # A metre above the base, x of the camera along x of the base, looking straight down.
    base_from_camera = pose([0.0, 1.0, 0.0, 0.0], [0.1, 0.2, 1.0])
    axes = axes_in_view(PINHOLE, base_from_camera.inverse())
    assert axes.origin_px == pytest.approx((320 - 60, 240 + 0.2 * 610))
    assert axes.lines[0][-1] == pytest.approx((320, 240 + 0.2 * 610))  # x to the right
    assert axes.lines[1][-1] == pytest.approx((320 - 60, 240 + 0.1 * 610))  # y up
    assert axes.lines[2][-1] == pytest.approx((320 - 60 / 0.9, 240 + 0.2 * 610 / 0.9))  # z closer
    assert axes.outside == ""


def test_axes_behind_the_camera_are_clipped() -> None:
    # The origin lies 4 cm behind the lens and to its right; z, forward, comes into view after that.
    axes = axes_in_view(PINHOLE, pose([1.0, 0, 0, 0], [0.01, 0.0, -0.04]), 0.1)
    assert "behind the camera, 40 mm" in axes.outside
    assert np.isnan(axes.origin_px).all()
    assert np.isnan(axes.lines[0]).all()
    assert np.isnan(axes.lines[1]).all()
    along = axes.lines[2]
    assert along[-1] == pytest.approx((320 + 600 * 0.01 / 0.06, 240))
    visible = along[np.isfinite(along[:, 0])]
    assert len(visible) > 20
    assert (visible[:, 0] > 320).all()  # never mirrored to the other side
    rotated = axes_in_view(PINHOLE, pose([0.0, 0, 1, 0], [0.01, 0.0, 0.06]), 0.1)
    assert rotated.outside == ""
    assert np.isfinite(rotated.lines[2][:10]).all()  # z points at the camera and past it


@pytest.mark.parametrize(
    ("position", "side"),
    [
        ((-2.0, 0, 1), "left of"),
        ((2.0, 0, 1), "right of"),
        ((0, -2.0, 1), "above"),
        ((0, 2.0, 1), "below"),
        ((-2.0, 2.0, 1), "left of and below"),
        ((90.0, 0, 1), "right of"),
    ],
)
@pytest.mark.parametrize("camera", [PINHOLE, DISTORTED])
def test_side_of_an_origin_outside_the_image_is_named(
    camera: Camera, position: tuple[float, float, float], side: str
) -> None:
    axes = axes_in_view(camera, pose([1.0, 0, 0, 0], position))
    assert axes.outside == f"outside the image, {side} it"


def test_strong_distortion_does_not_fold_points_into_the_image() -> None:
    barrel = Camera(640, 480, 600.0, 600.0, 320.0, 240.0, (-0.4, 0.0, 0.0, 0.0))
    far = [1.7, 0.0, 1.0]
    # The polynomial folds: what stands far to the side would appear inside the image.
    assert 0 < 320 + 600 * 1.7 * (1 - 0.4 * 1.7**2) < 640
    axes = axes_in_view(barrel, pose([1.0, 0, 0, 0], far))
    assert np.isnan(axes.origin_px).all()
    assert "right of" in axes.outside


def test_axes_are_drawn_in_their_colours_at_any_scale() -> None:
    axes = axes_in_view(PINHOLE, AHEAD)
    for scale in (1.0, 2.0):
        size = (round(640 * scale), round(480 * scale))
        image = cv2.resize(GREY, size).astype(np.uint8)
        drawn = draw_axes(image, axes.scaled(scale), "base").astype(int)
        for line, strongest in zip(axes.lines, range(3), strict=True):
            x, y = np.round((line[20] + 0.5) * scale - 0.5).astype(int)
            assert drawn[y, x].argmax() == strongest
            assert np.ptp(drawn[y, x]) > 80
    assert (GREY == 128).all()


def test_older_axes_are_pale_and_dashed() -> None:
    axes = axes_in_view(PINHOLE, AHEAD)
    pale = draw_axes(GREY, axes, older=True).astype(int)
    whole = draw_axes(GREY, axes).astype(int)
    assert 0 < (np.ptp(pale, axis=2) > 40).sum() < (np.ptp(whole, axis=2) > 40).sum()
    assert (
        pale[np.ptp(pale, axis=2) > 40].sum(1).mean()
        > whole[np.ptp(whole, axis=2) > 40].sum(1).mean()
    )


def test_directions_are_drawn_in_the_corner() -> None:
    axes = axes_in_view(PINHOLE, pose([1.0, 0, 0, 0], [0, 0, -1]))
    drawn = draw_directions(GREY, axes, "gripper")
    moved = np.argwhere((drawn != 128).any(axis=2))
    assert len(moved) > 100
    assert moved[:, 0].min() > 240
    assert moved[:, 1].max() < 320


def test_close_up_is_centred_on_the_origin() -> None:
    camera = Camera(640, 480, 600.0, 600.0, 320.0, 240.0)
    axes = axes_in_view(camera, pose([1.0, 0, 0, 0], [0.5, 0.3, 3.0]))
    image = np.zeros((960, 1280, 3), np.uint8)  # twice the size of the camera's
    image[:, : round(2 * float(axes.origin_px[0] + 0.5) - 0.5)] = 255
    part = close_up(image, camera, axes, None, 201)
    assert part is not None
    assert part.shape == (201, 201, 3)
    edge = np.flatnonzero(np.diff((part[5, :, 0] > 128).astype(int)))
    assert edge == pytest.approx([100], abs=3)
    beside = axes_in_view(camera, pose([1.0, 0, 0, 0], [5.0, 0.3, 3.0]))
    assert close_up(image, camera, beside, None, 201) is None
    near = axes_in_view(camera, pose([1.0, 0, 0, 0], [0.0, 0.0, 0.2]))
    assert close_up(image, camera, near, None, 201) is None
