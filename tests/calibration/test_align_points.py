"""A map is aligned to the base frame by touched points."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evercal.calibration.align import Picks, align_by_points
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.mapping.map_frame import Similarity

CAMERA = Camera(640, 480, 600, 600, 320, 240)
MIDDLE = np.array([0.5, 0.0, 0.2])


def views(
    truth: Similarity, points: np.ndarray, sigma_px: float, rng: np.random.Generator
) -> list[Picks]:
    """Noisy picks in four located images around the points."""
    images = []
    for _ in range(4):
        eye = MIDDLE + 1.2 * Rotation.random(rng=rng).apply([0, 0, -1])
        z = (MIDDLE - eye) / 1.2
        x = np.cross([0, 0.3, 1], z)
        x /= np.linalg.norm(x)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = np.stack([x, np.cross(z, x), z], 1), eye
        base_from_camera = SE3.from_matrix(matrix)
        pixels = CAMERA.project(base_from_camera.inverse().apply(points))
        pixels = pixels + rng.normal(0, sigma_px, pixels.shape)
        map_from_camera = truth.inverse_pose(base_from_camera)
        names = tuple(f"p{i}" for i in range(len(points)))
        images.append(Picks(map_from_camera, CAMERA, points, names, pixels))
    return images


def drawn(seed: int) -> tuple[Similarity, np.ndarray, np.random.Generator]:
    rng = np.random.default_rng(seed)
    truth = Similarity(SE3.exp(rng.normal(0, 1, 6)), float(np.exp(rng.normal(0, 0.5))))
    return truth, rng.uniform(-0.3, 0.3, (6, 3)) + MIDDLE, rng


def test_exact_picks_give_the_exact_similarity() -> None:
    truth, points, rng = drawn(0)
    fit = align_by_points(views(truth, points, 0.0, rng), scale_known=False)
    assert fit.similarity.scale == pytest.approx(truth.scale, rel=1e-6)
    in_map = truth.base_from_map.inverse().apply(points) / truth.scale
    assert fit.similarity.points(in_map) == pytest.approx(points, abs=1e-6)


def test_covariance_covers_the_errors() -> None:
    squared = []
    for seed in range(25):
        truth, points, rng = drawn(seed)
        fit = align_by_points(views(truth, points, 1.0, rng), scale_known=False)
        in_map = truth.base_from_map.inverse().apply(points) / truth.scale
        estimate = fit.similarity.points(in_map)
        # The seven parameters that map the estimates to the points, by linear least squares.
        rows = []
        for x, y, z in estimate:
            rotation = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
            away = np.array([x, y, z]) - points.mean(0)
            rows.append(np.column_stack([np.eye(3), rotation, away]))
        error = np.linalg.lstsq(np.concatenate(rows), (points - estimate).ravel(), rcond=None)[0]
        squared.append(error @ np.linalg.solve(fit.covariance, error))
    assert 2.5 < np.mean(squared) < 9.0  # 7 for an exact covariance


def test_too_few_points_and_points_on_a_line_are_refused() -> None:
    truth, points, rng = drawn(0)
    line = MIDDLE + np.linspace(-0.2, 0.2, 4)[:, None] * np.array([1.0, 0.5, 0.2])
    with pytest.raises(InputError, match="on one line"):
        align_by_points(views(truth, line, 0.0, rng), scale_known=True)
    with pytest.raises(InputError, match="2 points were picked"):
        align_by_points(views(truth, points[:2], 0.0, rng), scale_known=True)
