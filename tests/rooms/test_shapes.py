"""Meshes against closed forms: volume by the divergence theorem, normals, bounds."""

import numpy as np
import pytest

from rooms.shapes import Mesh, ball, box, cushion, cylinder, lathe, sheet

pytestmark = pytest.mark.slow("rooms", "src/evercal/simulation")


def volume(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(mesh.vertices_m[mesh.faces], 1, 0)
    return float((a * np.cross(b, c)).sum() / 6)


def test_volumes_match_closed_forms() -> None:
    assert volume(box(0.4, 0.3, 0.2, 1e-4)) == pytest.approx(0.024, rel=2e-3)
    assert volume(ball(0.5, segments=96)) == pytest.approx(np.pi / 6, rel=5e-3)
    assert volume(cylinder(0.3, 0.5, 1e-4, 128)) == pytest.approx(
        np.pi * 0.09 * 0.5, rel=5e-3
    )
    # Steiner's formula for a box with rounded edges.
    a = 0.4 - 0.1
    b = 0.3 - 0.1
    c = 0.2 - 0.1
    r = 0.05
    steiner = a * b * c + 2 * r * (a * b + b * c + c * a) + np.pi * r**2 * (a + b + c)
    rounded = volume(box(0.4, 0.3, 0.2, r, steps=24))
    assert rounded == pytest.approx(steiner + 4 / 3 * np.pi * r**3, rel=2e-3)


@pytest.mark.parametrize(
    "mesh",
    [
        box(0.4, 0.3, 0.2, 0.03),
        ball(0.2),
        cylinder(0.1, 0.3),
        cushion(0.4, 0.4, 0.2),
        lathe([(0, 0), (0.1, 0), (0.12, 0.1), (0.05, 0.2), (0, 0.2)]),
        sheet((0, 0, 0), (1, 0, 0), (0, 1, 0)),
    ],
)
def test_faces_and_normals_agree(mesh: Mesh) -> None:
    corners = mesh.vertices_m[mesh.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=-1)
    agree = (cross * mesh.normals[mesh.faces].mean(1)).sum(-1) > 0
    assert area[agree].sum() > 0.99 * area.sum()
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=-1), 1, atol=1e-6)


def test_boxes_stand_on_the_ground() -> None:
    points = box(0.4, 0.3, 0.2, 0.03).vertices_m
    np.testing.assert_allclose(points.min(0), (-0.2, -0.15, 0), atol=1e-12)
    np.testing.assert_allclose(points.max(0), (0.2, 0.15, 0.2), atol=1e-12)
