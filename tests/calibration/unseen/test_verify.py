"""A calibration is tested by data that it has not seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from evercal.calibration.calibration import Calibration
from evercal.calibration.evidence import Data, plus
from evercal.calibration.picked_points import PickedPoint
from evercal.calibration.unseen.targets import TargetView, target_data
from evercal.calibration.unseen.touched import (
    Touches,
    touched_data,
    touched_tips,
)
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, UncertainPose
from evercal.robot.pose_errors import ArmErrors
from evercal.simulation.box_room import look_at

CAMERA = Camera(640, 480, 600.0, 600.0, 319.5, 239.5)
TRIPOD = look_at(np.array([0.1, 0.5, 0.7]), np.array([0.5, 0.0, 0.05]))
WRIST = SE3.from_translation([0.05, -0.04, 0.03]) @ SE3.exp([0, 0, 0, 0.1, 0.0, 0.7])
SIGMA = np.repeat([4e-4, np.deg2rad(0.04)], 3)
TOOL = np.array([0.01, -0.02, 0.12])


def calibration(pose: SE3, moves: bool = False) -> Calibration:
    mount = "eye_in_hand" if moves else "eye_to_hand"
    return Calibration(mount, pose, np.diag(SIGMA**2), camera=CAMERA)


def down(points: np.ndarray, seed: int = 0) -> SE3:
    """Gripper poses (k,) that touch points with `TOOL`."""
    turns = np.random.default_rng(seed).uniform(-0.6, 0.6, (len(points), 6)) * [
        0,
        0,
        0,
        1,
        1,
        1,
    ]
    turned = SE3.exp([0, 0, 0, np.pi, 0, 0]) @ SE3.exp(turns)
    return SE3.from_translation(points - turned.apply(TOOL)) @ turned


def points(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.array([0.5, 0, 0.05]) + rng.uniform(-1, 1, (count, 3)) * [
        0.12,
        0.12,
        0.05,
    ]


def above(count: int) -> SE3:
    """Gripper poses (count,) from which the wrist camera sees the points."""
    rng = np.random.default_rng(1)
    poses = []
    for _ in range(count):
        eye = np.array([0.5, 0, 0.5]) + rng.uniform(-0.15, 0.15, 3)
        poses.append(look_at(eye, np.array([0.5, 0, 0.05])) @ WRIST.inverse())
    return SE3.stack(poses)


def touched(true: SE3, stated: SE3, count: int, moves: bool = False) -> Data:
    """Exact touches and picks of a camera at its true pose."""
    own = points(count)
    grippers = above(count)
    names = [f"p{i}" for i in range(count)]
    picks = []
    for name, point, gripper in zip(names, own, grippers, strict=True):
        view = gripper @ true if moves else true
        pixel = CAMERA.project(view.inverse().apply(point))
        picks.append(PickedPoint(f"{name}.png", name, pixel))
    poses = {pick.image: pose for pick, pose in zip(picks, grippers, strict=True)}
    touches = touched_tips(dict(zip(names, own, strict=True)))
    return touched_data(calibration(stated, moves), touches, picks, poses)


def board(
    true: SE3, moves: bool, count: int = 4
) -> tuple[dict[str, TargetView], dict[str, SE3]]:
    grippers = above(count)
    placed = SE3.from_translation([0.5, 0, 0.05])
    if moves:
        seen = (grippers @ true).inverse() @ placed
    else:
        seen = true.inverse() @ grippers @ SE3.from_translation([0, 0, 0.1])
    names = [f"{i}.png" for i in range(count)]
    noise = np.diag(np.repeat([2e-4, 3e-4], 3) ** 2)
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0.1, 0.1, 0.0]])
    views = [TargetView(UncertainPose(pose, noise), corners) for pose in seen]
    return dict(zip(names, views, strict=True)), dict(zip(names, grippers, strict=True))


@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("kind", ["points", "board"])
def test_residuals_are_the_error_of_the_calibration(kind: str, moves: bool) -> None:
    true = WRIST if moves else TRIPOD
    error = np.array([1e-5, -2e-5, 1.5e-5, 3e-5, -2e-5, 1e-5])
    stated = plus(true, -error)
    if kind == "points":
        data = touched(true, stated, 3, moves)
        free = np.eye(6)
    else:
        views, grippers = board(true, moves)
        data = target_data(calibration(stated, moves), views, grippers)
        # The mean of all images is an unknown constant.
        count = len(views)
        free = np.kron(np.eye(count) - 1 / count, np.eye(6))
    evidence = data.evidence(stated, ArmErrors())
    np.testing.assert_allclose(
        free @ evidence.residual, free @ evidence.slope @ error, rtol=2e-3, atol=1e-8
    )


@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("kind", ["points", "board"])
def test_a_right_calibration_is_honest_and_a_moved_camera_is_not(
    kind: str, moves: bool
) -> None:
    true = WRIST if moves else TRIPOD
    for shift, agrees in ((0.0, True), (0.008, False)):
        stated = plus(true, np.array([shift, 0, 0, 0, shift, 0]))
        own = calibration(stated, moves)
        if kind == "points":
            data = touched(true, stated, 8, moves)
        else:
            data = target_data(own, *board(true, moves, 8))
        found = own.verify(data)
        assert found.agrees == agrees
        if not agrees:
            assert found.verdict == "not as stated"
            assert max(found.causes, key=lambda name: found.causes[name]).endswith(
                "camera"
            )
            assert 3 < found.error_mm < 20
            assert found.error_95_mm > found.error_mm


def test_errors_are_stated_at_the_touched_place() -> None:
    stated = plus(TRIPOD, np.array([0.01, 0, 0, 0, 0, 0]))
    found = calibration(stated).verify(touched(TRIPOD, stated, 5))
    assert found.error_mm == pytest.approx(10, rel=0.2)
    assert found.reach_m == pytest.approx(0.6, abs=0.1)
    assert "within" in found.sentence
    assert "not as stated" in repr(found)
    miss = max(found.misses_m.values())
    assert miss == pytest.approx(0.009, abs=0.002)


def test_a_small_statement_is_not_decided_by_coarse_touches() -> None:
    own = replace(calibration(TRIPOD), covariance=np.diag(SIGMA**2) / 100)
    found = own.verify(touched(TRIPOD, TRIPOD, 2))
    assert found.verdict == "cannot tell"
    assert "more exact" in found.advice


def test_the_tool_is_estimated_where_one_point_is_touched_in_three_orientations() -> (
    None
):
    own = points(2)[[0, 0, 0, 1]]
    touches = Touches(("a", "a#2", "a#3", "b"), down(own))
    found = touches.positions(touches.base_from_gripper, np.zeros(3))
    np.testing.assert_allclose(found["a"], own[0], atol=1e-9)
    np.testing.assert_allclose(found["b"], own[3], atol=1e-9)
    for few in (
        Touches(("a", "b"), down(own)[[0, 3]]),
        Touches(("a", "a#2"), down(own[:2])),
    ):
        with pytest.raises(InputError, match="three orientations"):
            few.positions(few.base_from_gripper, np.zeros(3))
    stated = Touches(("a", "b"), down(own)[[0, 3]], TOOL)
    found = stated.positions(stated.base_from_gripper, np.zeros(3))
    np.testing.assert_allclose(found["b"], own[3], atol=1e-9)


def test_depth_tells_along_the_ray() -> None:
    stated = plus(TRIPOD, np.r_[0.08 * TRIPOD.rotation_matrix()[:, 2], 0, 0, 0])
    touches = touched_tips({"a": points(1)[0]})
    seen = TRIPOD.inverse().apply(points(1)[0])
    own = calibration(stated)
    results = []
    for depth in (np.nan, seen[2]):
        pick = PickedPoint("a.png", "a", CAMERA.project(seen), depth)
        data = touched_data(own, touches, [pick], {})
        results.append(own.verify(data).verdict)
    assert results == ["honest", "not as stated"]


def test_impossible_data_are_refused() -> None:
    own = calibration(TRIPOD)
    point = points(1)[0]
    touches = touched_tips({"a": point})
    pixel = CAMERA.project(TRIPOD.inverse().apply(point))
    with pytest.raises(InputError, match="b was picked and not touched; touched are a"):
        touched_data(own, touches, [PickedPoint("x.png", "b", pixel)], {})
    outside = PickedPoint("x.png", "a", np.array([700.0, 20.0]))
    with pytest.raises(InputError, match="outside the image of 640x480"):
        touched_data(own, touches, [outside], {})
    millimetres = touched_tips({"a": 1000 * point})
    data = touched_data(own, millimetres, [PickedPoint("x.png", "a", pixel)], {})
    with pytest.raises(InputError, match="metres"):
        own.verify(data)
    with pytest.raises(InputError, match="robot_poses"):
        touched_data(
            calibration(WRIST, True), touches, [PickedPoint("x.png", "a", pixel)], {}
        )
    views, grippers = board(WRIST, True)
    inverse = {name: pose.inverse() for name, pose in grippers.items()}
    moving = calibration(WRIST, True)
    data = target_data(moving, views, inverse)
    with pytest.raises(InputError, match="not the inverse"):
        moving.verify(data)
    with pytest.raises(InputError, match="two or more"):
        target_data(calibration(WRIST, True), dict([*views.items()][:1]), grippers)
    with pytest.raises(InputError, match="robot_poses"):
        target_data(calibration(WRIST, True), views, {})
