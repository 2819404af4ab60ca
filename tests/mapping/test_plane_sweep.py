"""Depths of walls whose features are known in closed form."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3
from evercal.mapping.covisibility import select_source_views
from evercal.mapping.plane_sweep import (
    FAR_M,
    NEAR_M,
    PLANES,
    SEEN_BY,
    SMOOTHING,
    PosedCells,
    _SourceView,
    inverse_depths,
    parabola,
    peak,
)

STRIDE = 8
CAMERA = Camera(320, 240, 280.0, 280.0, 159.5, 119.5)
DISTORTED = Camera(320, 240, 280.0, 280.0, 159.5, 119.5, (-0.15, 0.02, 0.0, 0.0))


def look_from(x: float, y: float = 0.0, angle_rad: float = 0.0) -> SE3:
    """A camera beside the origin that looks along z, rotated about its own y axis."""
    return SE3.exp(np.array([x, y, 0, 0, 0, 0])) @ SE3.exp(
        np.array([0, 0, 0, 0, angle_rad, 0])
    )


def true_depth(rays: np.ndarray, pose: SE3, wall_m: float, tilt: float) -> np.ndarray:
    """Depth (n,) along the optical axis of the wall z = wall + tilt x."""
    direction = rays @ pose.rotation_matrix().T
    eye = pose.translation_m
    along = (wall_m + tilt * eye[0] - eye[2]) / (
        direction[:, 2] - tilt * direction[:, 0]
    )
    return along


def cells(
    pose: SE3, wall_m: float, camera: Camera = CAMERA, tilt: float = 0.0, seed: int = 0
) -> PosedCells:
    """A view of a wall whose features vary smoothly over it, with 15 cm from hill to hill."""
    view = PosedCells(np.zeros(0), camera, pose, STRIDE)
    depth = true_depth(view.rays(), pose, wall_m, tilt)
    points = pose.apply(view.rays() * depth[:, None])
    rng = np.random.default_rng(seed)
    waves = rng.normal(0, 2 * np.pi / 0.6, (2, 64))
    features = np.cos(points[:, :2] @ waves + rng.uniform(0, 2 * np.pi, 64))
    unit = features / np.linalg.norm(features, axis=1, keepdims=True)
    return PosedCells(unit.astype(np.float32), camera, pose, STRIDE)


@pytest.mark.parametrize("camera", [CAMERA, DISTORTED], ids=["pinhole", "distorted"])
@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_other_views_determine_the_depth(camera: Camera, tilt: float) -> None:
    view = cells(look_from(0), 2.0, camera, tilt)
    others = [
        cells(look_from(x, y), 2.0, camera, tilt) for x, y in ((0.3, 0), (-0.2, 0.2))
    ]
    truth = true_depth(view.rays(), view.base_from_camera, 2.0, tilt)
    for off in (0.8, 1.0, 1.3):
        depth = 1 / inverse_depths(view, others, off * truth)
        inner = truth.reshape(30, 40)[6:24, 8:32].ravel()
        error = np.abs(depth.reshape(30, 40)[6:24, 8:32].ravel() / inner - 1)
        assert np.median(error) < 0.01
        assert np.quantile(error, 0.9) < 0.03


def similarities(view: PosedCells, other: PosedCells, planes: np.ndarray) -> np.ndarray:
    """(cells, planes) at inverse depths, one cell after the other."""
    rows, columns = other.grid
    across = other.base_from_camera.inverse() @ view.base_from_camera
    found = np.zeros((len(view.features), len(planes)))
    for cell, ray in enumerate(view.rays()):
        if not np.isfinite(ray).all():
            continue
        grid = (other.features @ view.features[cell]).reshape(rows, columns)
        points = across.apply(ray / planes[:, None])
        seen = points[:, 2] * planes > 0.05
        pixels = other.camera.project(np.where(seen[:, None], points, [0, 0, 1]))
        low = -STRIDE / 2 - 0.5
        high = STRIDE * (np.array([columns, rows]) + 0.5) - 0.5
        seen &= ((pixels > low) & (pixels < high)).all(1)
        at = (np.nan_to_num(pixels) + 0.5) / STRIDE - 0.5
        values = map_coordinates(grid, at.T[::-1], order=1, mode="nearest")
        found[cell] = np.where(seen, np.maximum(values, 0), 0)
    return found


@pytest.mark.parametrize("camera", [CAMERA, DISTORTED], ids=["pinhole", "distorted"])
def test_best_plane_is_that_of_a_sweep_cell_by_cell(
    camera: Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Not refined.
    monkeypatch.setattr("evercal.mapping.plane_sweep.MIN_PEAK_SIMILARITY", 2.0)
    places = (0.4, 0.1), (-0.3, 0), (0.2, -0.3, 0.4), (-0.1, 0.3), (9, 0)
    poses = [look_from(*place) for place in places]
    view = cells(look_from(0), 2.0, camera)
    others = [cells(p, 2.0, camera) for p in poses]
    planes = np.linspace(1 / FAR_M, 1 / NEAR_M, PLANES)
    swept = np.stack([similarities(view, other, planes) for other in others])
    for other, expected in zip(others, swept, strict=True):
        # OpenCV interpolates at 1/32 of a cell.
        found = _SourceView(view, other).along(planes.astype(np.float32))
        np.testing.assert_allclose(found, expected, atol=0.03)
    assert len(others) > SEEN_BY
    score = np.sort(swept, 0)[-SEEN_BY:].mean(0).reshape(*view.grid, PLANES)
    smooth = np.empty_like(score)
    for i, j in np.ndindex(*view.grid):
        near = score[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2].mean((0, 1))
        smooth[i, j] = (1 - SMOOTHING) * score[i, j] + SMOOTHING * near
    inverse = inverse_depths(view, others, np.ones(1200))
    chosen = np.abs(inverse[:, None] - planes).argmin(1)
    np.testing.assert_allclose(inverse, planes[chosen], rtol=1e-5)
    assert np.mean(chosen == smooth.reshape(-1, PLANES).argmax(1)) > 0.98
    taken = np.take_along_axis(smooth.reshape(-1, PLANES), chosen[:, None], 1)[:, 0]
    np.testing.assert_allclose(taken, smooth.reshape(-1, PLANES).max(1), atol=0.01)


def test_views_of_another_wall_do_not_determine_the_depth() -> None:
    view = cells(look_from(0), 2.0)
    unrelated = [cells(look_from(0.3), 2.0, seed=5)]
    depth = 1 / inverse_depths(view, unrelated, np.full(1200, 1.2))
    assert np.mean(np.abs(depth / 2.0 - 1) < 0.02) < 0.2


def test_without_other_views_the_guess_is_returned() -> None:
    view = cells(look_from(0), 2.0)
    guess = np.linspace(0.1, 20.0, 1200)
    inverse = inverse_depths(view, [], guess)
    np.testing.assert_allclose(1 / inverse, np.clip(guess, 0.25, 12.0), rtol=1e-5)


def test_selected_views_have_parallax() -> None:
    view = cells(look_from(0), 2.0)
    near = look_from(0.01)
    side = look_from(0.3)
    wide = look_from(2.5)
    away = look_from(0.3, angle_rad=np.pi)
    beyond = look_from(0.3, angle_rad=np.deg2rad(75))
    poses = SE3.stack([look_from(0), near, away, side, beyond, wide])
    depth = np.full(1200, 2.0)
    assert select_source_views(depth, view, poses, [CAMERA] * 6, 5) == [3]
    # At most `count` views.
    sides = SE3.stack([look_from(0.1), look_from(0.2), look_from(-0.25)])
    assert len(select_source_views(depth, view, sides, [CAMERA] * 3, 2)) == 2


def test_peak_between_cells() -> None:
    row, column = np.mgrid[0:9, 0:12]
    hill = 1 - 0.02 * ((row - 4.3) ** 2 + (column - 6.8) ** 2)
    for start in ((4, 6), (5, 7), (4, 7), (3, 6)):
        position, (value,) = peak(
            hill[None], np.array([start[0]]), np.array([start[1]])
        )
        np.testing.assert_allclose(position[0], [6.8, 4.3], atol=1e-3)
        assert float(value) == pytest.approx(hill[4, 7], abs=1e-6)
    # At most half a cell.
    assert parabola(np.zeros(1), np.zeros(1), np.ones(1)) == 0.5
