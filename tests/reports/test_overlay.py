"""Landmarks, residuals and axes are drawn where independent formulas say."""

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from evercal.geometry import SE3, Camera
from evercal.localization.estimate import PoseEstimate
from evercal.mapping.map_frame import MapFrame
from evercal.mapping.scene_map import SceneMap
from evercal.reports.overlay import (
    axes_in_view,
    draw_axes,
    draw_landmarks,
    draw_residuals,
    exaggeration,
    origin_in_view,
    overlay_lines,
)

GREY = np.full((60, 80, 3), 128, np.uint8)
PINHOLE = Camera(640, 480, 600.0, 610.0, 320.0, 240.0)
DISTORTED = Camera(
    640, 480, 600.0, 610.0, 320.0, 240.0, (-0.3, 0.1, 0.001, -0.002, 0.01)
)


def turned(quaternion: list[float], translation: list[float]) -> SE3:
    return SE3(np.array(quaternion), np.array(translation))


def dots(pixels: Any, residuals: Any, image: np.ndarray = GREY) -> np.ndarray:
    """Points without vectors, coloured from 0 to 1."""
    at = np.asarray(pixels, np.float64).reshape(-1, 2)
    return draw_residuals(
        image, at, np.zeros_like(at), np.asarray(residuals, np.float64), 1.0
    )[0]


def test_dots_are_placed_with_subpixel_accuracy() -> None:
    centres = []
    for x in (40.0, 40.25, 40.5):
        weight = np.abs(dots([x, 20.0], [1.0]).astype(float) - 128).sum(2)
        y, columns = np.indices(weight.shape)
        centres.append((columns * weight).sum() / weight.sum())
        assert (y * weight).sum() / weight.sum() == pytest.approx(20.0, abs=0.1)
    assert centres == pytest.approx([40.0, 40.25, 40.5], abs=0.15)
    assert (GREY == 128).all()


def test_points_that_are_far_away_or_not_finite_are_omitted() -> None:
    away = [[-9, 20], [40, 1e12], [np.nan, 3], [np.inf, 3], [40, -np.inf], [89, 20]]
    assert (dots(away, np.zeros(6)) == GREY).all()
    assert (dots([], []) == GREY).all()


def test_residuals_run_from_dark_to_light_and_are_clipped() -> None:
    at = [[10, 10], [20, 10], [30, 10], [40, 10], [50, 10], [60, 10]]
    drawn = dots(at, [-5.0, 0.0, 0.5, 1.0, 9.0, np.nan]).astype(int)
    colours = [drawn[10, x].tolist() for x, _ in at]
    assert colours[0] == colours[1]
    assert colours[3] == colours[4]
    assert sum(colours[1]) < sum(colours[2]) < sum(colours[3])
    assert colours[1][2] > colours[1][1]  # viridis starts blue
    assert colours[3][0] > 200 > 100 > colours[3][2]  # and ends yellow
    assert len(set(colours[5])) == 1


@pytest.mark.parametrize("shape", [(240, 320), (40, 60), (3, 3)])
def test_a_legend_is_drawn_where_there_is_room(shape: tuple[int, int]) -> None:
    drawn = dots([0, 0], [0.5], np.zeros((*shape, 3), np.uint8))
    assert (drawn[shape[0] // 2 :].max() == 255) == (shape == (240, 320))
    assert drawn.shape == (*shape, 3)


@pytest.mark.parametrize(
    ("length", "times"), [(0.1, 100), (0.6, 50), (2.4, 20), (51.0, 1), (np.nan, 1)]
)
def test_lines_are_exaggerated_by_a_round_factor(length: float, times: int) -> None:
    vectors = np.full((20, 2), length / 2**0.5)
    assert exaggeration(vectors) == times
    vectors[0] = 500.0  # an outlier does not shorten the others
    assert exaggeration(vectors) == times


def test_one_line_is_drawn_in_each_part_of_an_image() -> None:
    """A pattern shows; all landmarks have a dot."""
    rng = np.random.default_rng(0)
    pixels = rng.uniform([0, 0], [640, 480], (900, 2))
    nothing = np.zeros((480, 640, 3), np.uint8)
    vectors = np.tile([0.0, 2.0], (900, 1))
    drawn, times = draw_residuals(nothing, pixels, vectors, np.full(900, 0.1), 2.0)
    assert times == 20
    orange = (drawn == (255, 140, 40)).all(-1).astype(np.uint8)
    lines = cv2.connectedComponents(orange)[0] - 1
    assert 80 < lines < 140 * 2  # some lie behind the dots of others


def test_lines_have_their_colour_and_gaps() -> None:
    line = np.array([[10, 30], [40, 30], [np.nan, 30], [60, 30], [70, 30]])
    drawn = overlay_lines(GREY, [line], [(200, 10, 20)], 3)
    assert [drawn[30, x].tolist() for x in (25, 65)] == [[200, 10, 20]] * 2
    assert drawn[30, 50].tolist() == [128, 128, 128]
    for nothing in (
        [[np.nan, 1], [np.inf, 2]],
        [[3, 3]],
        np.zeros((0, 2)),
        [[1e9, 1], [1e12, 5]],
    ):
        points = np.asarray(nothing, np.float64)
        assert (overlay_lines(GREY, [points], [(0, 0, 0)], 2) == GREY).all()


def test_landmarks_are_coloured_by_their_reprojection_error() -> None:
    lens = Camera(320, 240, 300, 300, 159.5, 119.5)
    common = SE3.exp([0.01, 0.02, -0.01, 0.02, 0, 0.01])
    adjusted = SE3.exp([0.3, 0.1, 0.2, 0.1, -0.2, 0.05])
    points = adjusted.apply([[0.2, 0.1, 2.0], [-0.3, 0.2, 1.5]])
    pixels = lens.project(adjusted.inverse().apply(points))
    pixels[1] += [1.2, 1.6]  # two pixels off
    keyframes: Any = None
    scene = SceneMap("room", lens, lens, keyframes, MapFrame(common), 10)
    localizer: Any = SimpleNamespace(
        contents=SimpleNamespace(scenes=[scene], short_side=240)
    )
    pose = adjusted @ common.inverse()
    estimate = PoseEstimate("ok", "", "room", pose, None, 2, 0.5, 1.0, pixels, points)
    image = np.full((240, 320, 3), 90, np.uint8)
    picture = draw_landmarks(image, estimate, localizer)
    assert picture.image.shape == (480, 640, 3)
    assert picture.landmarks == 2
    assert "median residual 1.00 px" in picture.summary
    # The line leads up and to the left.
    exact, off = (
        picture.image[tuple(np.round(2 * at + 0.5 + [2, 2]).astype(int)[::-1])].astype(
            int
        )
        for at in pixels
    )
    assert exact[2] > exact[1]  # dark blue: no error
    assert off[0] > 200  # yellow: two pixels
    assert off[1] > 200
    failed = PoseEstimate("failed", "too dark", None, None, None, 0, 0.0, 1.0)
    nothing = draw_landmarks(image, failed, localizer)
    assert (nothing.image == 90).all()
    assert nothing.summary == "too dark"


@settings(max_examples=30)
@given(seed=st.integers(0, 10_000), camera=st.sampled_from([PINHOLE, DISTORTED]))
def test_projected_axes_agree_with_opencv(seed: int, camera: Camera) -> None:
    rng = np.random.default_rng(seed)
    pose = SE3(
        rng.normal(0, 1, 4),
        np.array([*rng.uniform(-0.2, 0.2, 2), rng.uniform(0.8, 2.0)]),
    )
    corners = np.vstack([np.zeros(3), 0.1 * np.eye(3)])
    rotation, _ = cv2.Rodrigues(pose.rotation_matrix())
    distortion = np.array(camera.distortion or (0.0,) * 4)
    expected, _ = cv2.projectPoints(
        corners, rotation, pose.translation_m, camera.matrix(), distortion
    )
    lines = axes_in_view(camera, pose, 0.1)
    assert lines[:, 0] == pytest.approx(np.repeat(expected[0], 3, 0), abs=1e-6)
    assert lines[:, -1] == pytest.approx(expected[1:, 0], abs=1e-6)
    assert origin_in_view(camera, pose)[0] == pytest.approx(expected[0, 0], abs=1e-6)


@pytest.mark.parametrize(
    ("position", "words"),
    [
        ((0.1, 0.1, 1), ""),
        ((-2.0, 0, 1), "outside the image"),
        ((0, 2.0, 1), "outside the image"),
        ((90.0, 0, 1), "outside the image"),
        ((0.01, 0.0, -0.04), "behind the camera"),
    ],
)
@pytest.mark.parametrize("camera", [PINHOLE, DISTORTED])
def test_place_of_an_origin_is_named(
    camera: Camera, position: tuple[float, float, float], words: str
) -> None:
    assert origin_in_view(camera, turned([1.0, 0, 0, 0], list(position)))[1] == words


def test_strong_distortion_does_not_fold_points_into_the_image() -> None:
    barrel = Camera(640, 480, 600.0, 600.0, 320.0, 240.0, (-0.4, 0.0, 0.0, 0.0))
    # The polynomial folds: what stands far to the side would appear inside the image.
    assert 0 < 320 + 600 * 1.7 * (1 - 0.4 * 1.7**2) < 640
    pixel, words = origin_in_view(barrel, turned([1.0, 0, 0, 0], [1.7, 0.0, 1.0]))
    assert np.isnan(pixel).all()
    assert words == "outside the image"


def test_axes_are_drawn_in_their_colours_at_any_size() -> None:
    pose = SE3.exp([0.05, -0.02, 1.0, 0.3, -0.4, 0.2])
    lines = axes_in_view(PINHOLE, pose)
    for scale in (1, 2):
        image = np.full((480 * scale, 640 * scale, 3), 128, np.uint8)
        drawn, pale = (
            draw_axes(image, PINHOLE, pose, pale=p).astype(int) for p in (False, True)
        )
        for line, strongest in zip(lines, range(3), strict=True):
            x, y = np.round((line[20] + 0.5) * scale - 0.5).astype(int)
            assert drawn[y, x].argmax() == pale[y, x].argmax() == strongest
            assert np.ptp(drawn[y, x]) > np.ptp(pale[y, x])
        assert (image == 128).all()


def test_directions_of_a_frame_behind_the_camera_are_drawn_in_the_corner() -> None:
    image = np.full((480, 640, 3), 128, np.uint8)
    drawn = draw_axes(image, PINHOLE, turned([1.0, 0, 0, 0], [0, 0, -1]))
    moved = np.argwhere((drawn != 128).any(axis=2))
    assert len(moved) > 100
    assert moved[:, 0].min() > 240
    assert moved[:, 1].max() < 320
