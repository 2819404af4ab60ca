"""Arms in rooms: where they are drawn, and what is done to their recordings."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from evercal.geometry import SE3, Camera
from evercal.robot.robot_model import RobotModel
from evercal.simulation.box_room import look_at

pytest.importorskip("trimesh", reason="the extra 'urdf' is not installed")

from benchmarks.arm_faults import Cell, spoil
from rooms.arm_shapes import ArmShapes
from rooms.arms import ARMS, urdf_of
from rooms.drawn_arms import Stage, coverage

SCARA = ARMS["scara"]
CAMERA = Camera(160, 120, 150.0, 150.0, 83.0, 57.0)
POSE = look_at(np.array([0.9, 0.7, 0.8]), np.array([0.2, 0.0, 0.25]))
VALUES = np.array([[0.3, 0.9, -0.05, 1.0], [-0.6, 0.4, 0.0, 0.0]] * 2)


def _stage() -> Stage:
    empty = np.zeros((120, 160), np.float32)
    return Stage(CAMERA, POSE, np.zeros((120, 160, 3), np.uint8), empty, np.ones(3))


def test_an_arm_covers_what_its_projected_corners_enclose() -> None:
    shapes = ArmShapes(urdf_of("scara"), SCARA.joints)
    model = RobotModel(urdf_of("scara"))
    whole = coverage(shapes, VALUES[0], _stage())
    (forearm, *_) = (part for part in shapes.parts if part.link == "forearm")
    frame = model.arm("base", "forearm").poses(VALUES[:1, :2])[0]
    corners = (np.indices((2, 2, 2)).reshape(3, -1).T - 0.5) * (0.3, 0.11, 0.12)
    in_base = frame.apply(np.add(corners, (0.12, 0, 0.06)))
    pixels = CAMERA.project(POSE.inverse().apply(in_base))
    hull = ConvexHull(pixels)
    shapes.parts = [forearm]
    alone = coverage(shapes, VALUES[0], _stage())
    v, u = np.mgrid[:120, :160]
    middle = [(alone * u).sum() / alone.sum(), (alone * v).sum() / alone.sum()]
    assert alone.sum() == pytest.approx(hull.volume, rel=0.003)
    np.testing.assert_allclose(middle, _centroid(pixels[hull.vertices]), atol=0.02)
    assert (whole >= alone - 1e-6).all()


def _centroid(corners: np.ndarray) -> np.ndarray:
    """Of a convex polygon (n, 2)."""
    following = np.roll(corners, -1, axis=0)
    cross = corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0]
    return ((corners + following) * cross[:, None]).sum(0) / (3 * cross.sum())


def test_what_is_nearer_hides_the_arm() -> None:
    shapes = ArmShapes(urdf_of("scara"), SCARA.joints)
    stage = _stage()
    stage.depth[:] = 0.1
    assert coverage(shapes, VALUES[0], stage).max() == 0


def test_faults_keep_the_truth_that_they_state() -> None:
    rng = np.random.default_rng(0)
    v, u = np.mgrid[:120, :160]
    dot = np.hypot(u - 100, v - 40) < 4
    image = np.repeat(np.where(dot, 255, 0)[..., None], 3, 2).astype(np.uint8)
    urdf = urdf_of("scara").read_text()
    cell = Cell([image.copy() for _ in VALUES], VALUES, CAMERA, urdf, "scara", [POSE])
    spoil(cell, "bump", 3.0, rng)
    far = POSE.apply(100 * CAMERA.unproject([[100.0, 40.0]]))
    expected = CAMERA.project(cell.base_from_camera[1].inverse().apply(far))[0]
    bright = cell.images[-1][..., 0].astype(float)
    seen = np.array([(bright * u).sum(), (bright * v).sum()]) / bright.sum()
    assert np.linalg.norm(expected - (100, 40)) > 1
    np.testing.assert_allclose(seen, expected, atol=0.1)

    spoil(cell, "half", 0.0, rng)
    small = cell.images[0][..., 0].astype(float)
    v, u = np.mgrid[:60, :80]
    seen = np.array([(small * u).sum(), (small * v).sum()]) / small.sum()
    ray = CAMERA.unproject([[100.0, 40.0]])
    np.testing.assert_allclose(seen, cell.camera.project(ray)[0], atol=0.05)


def test_meshes_of_a_spoiled_urdf_are_off_as_stated(tmp_path: Path) -> None:
    urdf = urdf_of("scara").read_text()
    for fault, size in (("mesh", 1.0), ("scale", 0.01)):
        cell = Cell([], VALUES, CAMERA, urdf, "scara", [SE3.identity()])
        spoil(cell, fault, size, np.random.default_rng(0))
        (tmp_path / "robot.urdf").write_text(cell.urdf)
        before = ArmShapes(urdf_of("scara"), SCARA.joints).parts
        after = ArmShapes(tmp_path / "robot.urdf", SCARA.joints).parts
        for old, new in zip(before, after, strict=True):
            moved = np.linalg.norm(new.vertices_m.mean(0) - old.vertices_m.mean(0))
            grown = np.ptp(new.vertices_m, 0) / np.ptp(old.vertices_m, 0)
            assert moved == pytest.approx(0.001 * (fault == "mesh"), abs=1e-9)
            np.testing.assert_allclose(grown, 1 + 0.01 * (fault == "scale"))
