"""Meshes against closed forms: volume by the divergence theorem, normals, bounds."""

import numpy as np
import pytest

from rooms.shapes import Mesh, ball, box, cushion, cylinder, lathe, sheet

pytestmark = pytest.mark.slow("rooms", "src/evercal/simulation")


def volume(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(mesh.vertices_m[mesh.faces], 1, 0)
    return float((a * np.cross(b, c)).sum() / 6)


def test_volumes_match_closed_forms() -> None:
    # Steiner's formula for a box of 0.4, 0.3 and 0.2 m with edges rounded by 0.05 m.
    r = 0.05
    steiner = 0.006 + 2 * r * 0.11 + np.pi * (r**2 * 0.6 + r**3 * 4 / 3)
    for mesh, expected, tolerance in (
        (box(0.4, 0.3, 0.2, 1e-4), 0.024, 2e-3),
        (ball(0.5, segments=96), np.pi / 6, 5e-3),
        (cylinder(0.3, 0.5, 1e-4, 128), np.pi * 0.045, 5e-3),
        (box(0.4, 0.3, 0.2, r, steps=24), steiner, 2e-3),
    ):
        assert volume(mesh) == pytest.approx(expected, rel=tolerance)


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
    a, b, c = np.moveaxis(mesh.vertices_m[mesh.faces], 1, 0)
    cross = np.cross(b - a, c - a)
    area = np.linalg.norm(cross, axis=-1)
    agree = (cross * mesh.normals[mesh.faces].mean(1)).sum(-1) > 0
    assert area[agree].sum() > 0.99 * area.sum()
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=-1), 1, atol=1e-6)


def test_boxes_stand_on_the_ground() -> None:
    points = box(0.4, 0.3, 0.2, 0.03).vertices_m
    np.testing.assert_allclose(points.min(0), (-0.2, -0.15, 0), atol=1e-12)
    np.testing.assert_allclose(points.max(0), (0.2, 0.15, 0.2), atol=1e-12)
