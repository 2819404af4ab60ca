"""Points, colours and shapes of scenes in 3D, against the geometry that defines them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evercal.geometry import SE3, Camera, UncertainPose
from evercal.mapping.map_frame import Similarity
from evercal.mapping.scene_map import MapContents, SceneMap
from evercal.reports.calibration_page import camera_views
from evercal.reports.overlay import resized
from evercal.reports.scene import (
    DRAWN_M,
    Ellipsoid,
    Frustum,
    Landmarks3D,
    Surroundings,
    keyframe_views,
    readable_scale,
    surface,
)

from .test_calibration_page import full

SIMILARITY = Similarity(SE3.exp([0.3, -0.2, 0.5, 0.4, -0.8, 0.2]), 2.5)


@pytest.fixture(params=["as recorded", "aligned"])
def scene(request: pytest.FixtureRequest, hall_map: MapContents) -> SceneMap:
    """The hall, and the hall in a base frame of another place and scale."""
    scene = hall_map.scenes[0]
    if request.param == "as recorded":
        return scene
    return replace(scene, frame=replace(scene.frame, similarity=SIMILARITY))


def test_landmarks_project_onto_their_pixels_and_have_their_grey(
    scene: SceneMap,
) -> None:
    landmarks = Landmarks3D.of(scene)
    keyframes = scene.keyframes
    assert len(landmarks) == scene.landmarks
    first = 0
    for view, marks in zip(keyframe_views(scene), keyframes.landmarks, strict=True):
        own = slice(first, first + len(marks))
        first += len(marks)
        local = view.frustum.base_from_camera.inverse().apply(landmarks.points_m[own])
        np.testing.assert_allclose(view.camera.project(local), marks.pixels, atol=1e-6)
        column, row = marks.pixels.round().astype(int).T
        np.testing.assert_array_equal(landmarks.grey[own], view.image[row, column, 0])


def test_surfaces_are_the_pixels_near_landmarks_at_about_their_depths(
    scene: SceneMap,
) -> None:
    alone = replace(scene, keyframes=scene.keyframes.take(np.array([1])))
    shown = surface(alone)
    (view,) = keyframe_views(alone)
    (marks,) = alone.keyframes.landmarks
    local = view.frustum.base_from_camera.inverse().apply(shown.points_m)
    pixels = view.camera.project(local)
    column, row = pixels.round().astype(int).T
    np.testing.assert_allclose(pixels, np.column_stack([column, row]), atol=1e-6)
    np.testing.assert_array_equal(shown.grey, view.image[row, column, 0])
    apart = np.linalg.norm(pixels[:, None] - marks.pixels, axis=2)
    assert (apart.min(axis=1) < 11).all()
    ratio = local[:, 2] / view.depths_m[apart.argmin(axis=1)]
    assert np.median(ratio) == pytest.approx(1, abs=0.02)
    assert len(shown) > 3 * len(marks)
    spacing_px = shown.sigma_mm / 1000 * view.camera.fx / np.linalg.norm(local, axis=1)
    np.testing.assert_allclose(spacing_px, 2, rtol=1e-6)


def test_deviation_is_the_distance_by_which_the_depth_moves_a_landmark(
    scene: SceneMap,
) -> None:
    landmarks = Landmarks3D.of(scene)
    share = 1e-4
    moved = scene.keyframes.take(np.arange(len(scene.keyframes)))
    nearer = [
        replace(m, inverse_depth=m.inverse_depth + share * m.sigma)
        for m in moved.landmarks
    ]
    other = Landmarks3D.of(
        replace(scene, keyframes=replace(moved, landmarks=tuple(nearer)))
    )
    apart_mm = 1000 * np.linalg.norm(landmarks.points_m - other.points_m, axis=1)
    np.testing.assert_allclose(apart_mm / share, landmarks.sigma_mm, rtol=1e-2)


def test_fewer_landmarks_are_drawn(hall_map: MapContents) -> None:
    whole, few = (Landmarks3D.of(hall_map.scenes[0], most) for most in (10**6, 300))
    assert len(few) == 300
    assert {tuple(p) for p in few.points_m} <= {tuple(p) for p in whole.points_m}


def test_colours_by_a_value_rise_with_it(hall_map: MapContents) -> None:
    landmarks = Landmarks3D.of(hall_map.scenes[0])
    for colours, values in (
        (landmarks.colours("height"), landmarks.points_m[:, 2]),
        (landmarks.colours("uncertainty"), landmarks.sigma_mm),
    ):
        green = colours[:, 1].astype(int)  # of viridis, it never falls
        assert (np.diff(green[np.argsort(values)]) >= 0).all()
    assert len(Landmarks3D.of(hall_map.scenes[0], 0).colours("height")) == 0


def test_corners_of_a_frustum_are_those_of_the_image() -> None:
    camera = Camera(64, 48, 50.0, 55.0, 31.5, 23.5)
    pose = SE3.exp([0.1, 0.2, 0.3, 0.5, -0.4, 0.3])
    corners = Frustum.of(pose, camera).corners(0.7)
    pixels = camera.project(pose.inverse().apply(corners))
    wanted = [(-0.5, -0.5), (63.5, -0.5), (63.5, 47.5), (-0.5, 47.5)]
    np.testing.assert_allclose(pixels, wanted, atol=1e-9)


@pytest.mark.parametrize("seed", range(8))
def test_axes_of_an_ellipsoid_are_the_eigenvectors(seed: int) -> None:
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(6, 6)) * [1, 2, 5, 1, 1, 1]
    covariance = 1e-6 * factor @ factor.T
    ellipsoid = Ellipsoid.of(UncertainPose(SE3.exp(rng.normal(size=6)), covariance))
    rotation = SE3(ellipsoid.rotation_wxyz, np.zeros(3)).rotation_matrix()
    assert np.linalg.det(rotation) == pytest.approx(1)
    for axis, sigma in zip(rotation.T, ellipsoid.axes_m, strict=True):
        np.testing.assert_allclose(
            covariance[:3, :3] @ axis, sigma**2 * axis, atol=1e-15
        )
    # Its surface is where the Mahalanobis distance is one.
    on_sphere = rng.normal(size=(50, 3))
    on_sphere /= np.linalg.norm(on_sphere, axis=1, keepdims=True)
    surface = (ellipsoid.axes_m * on_sphere) @ rotation.T
    squared = np.einsum(
        "ni,ij,nj->n", surface, np.linalg.inv(covariance[:3, :3]), surface
    )
    np.testing.assert_allclose(squared, 1, rtol=1e-6)


def test_a_flat_covariance_gives_a_flat_ellipsoid() -> None:
    covariance = np.diag([4e-6, 0, 1e-6, 0, 0, 0])
    ellipsoid = Ellipsoid.of(UncertainPose(SE3.identity(), covariance))
    np.testing.assert_allclose(ellipsoid.axes_m, [0, 1e-3, 2e-3], atol=1e-12)
    assert ellipsoid.sigmas_mm == "2 / 1 / 0"


@pytest.mark.parametrize(
    ("mm", "scale"), [(0.01, 500), (1.0, 50), (0.9, 50), (24.0, 2), (90.0, 1)]
)
def test_the_scale_is_round_and_draws_at_most_five_centimetres(
    mm: float, scale: int
) -> None:
    sigma = 1e-3 * mm
    ellipsoid = Ellipsoid(
        np.zeros(3), np.array([0, 0, sigma]), np.array([1.0, 0, 0, 0])
    )
    assert readable_scale([ellipsoid]) == scale
    assert scale * sigma <= DRAWN_M or scale == 1


def test_resizing_keeps_the_aspect_ratio() -> None:
    assert resized(np.zeros((48, 64, 3), np.uint8), 640).shape == (480, 640, 3)
    assert resized(np.zeros((480, 640, 3), np.uint8), 160).shape == (120, 160, 3)


def test_the_ellipsoid_is_smaller_than_the_camera_that_it_surrounds() -> None:
    """Whatever its size, in views along the same axes."""
    for metres in (1e-5, 3e-4, 2e-3):
        own = full(
            covariance=np.diag([*[metres**2, metres**2, 9 * metres**2], 0, 0, 0])
        )
        panels, _ = camera_views(own, Surroundings())
        for panel, plane in zip(panels, ("xy", "xz"), strict=True):
            assert [label[0] for label in panel.labels] == list(plane)
            (area,) = (s.points for s in panel.shapes if s.kind == "area")
            camera = next(s.points for s in panel.shapes if s.width == 2.2)
            assert np.ptp(area, axis=0).max() <= np.ptp(camera, axis=0).max()
