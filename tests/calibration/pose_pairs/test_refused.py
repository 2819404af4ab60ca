"""Recordings that do not determine a calibration, each refused with its own reason."""

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.board_recordings import BoardSetting, pose_pairs, record
from benchmarks.hand_eye import Setting, error, pose, recording, rotations, shaken
from benchmarks.pose_mistakes import MISTAKES, OTHER, Mistake
from evercal.calibration.pose_pairs.pairs import PosePairs
from evercal.calibration.pose_pairs.solve import solve
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.robot.mount import MountName

MOUNTS: tuple[MountName, ...] = ("eye_in_hand", "eye_to_hand")
EXACT = Setting(noise_mm=0, noise_deg=0)


def pairs_of(robot: SE3, mount: MountName, noise: float) -> PosePairs:
    """Simulate the camera poses of given robot poses."""
    truth = recording(replace(EXACT, mount=mount, path="table"), 0)
    fixed_from_parent = robot if mount == "eye_in_hand" else robot.inverse()
    camera = (
        fixed_from_parent @ truth.parent_from_camera
    ).inverse() @ truth.fixed_from_board
    setting = Setting(noise_mm=2 * noise, noise_deg=0.2 * noise)
    camera = shaken(camera, setting, np.random.default_rng(1))
    return PosePairs(tuple(f"row {i + 1}" for i in range(len(robot))), robot, camera)


def degenerate_motions() -> dict[str, tuple[SE3, str]]:
    rng = np.random.default_rng(2)
    positions = np.array([0.5, 0, 0.5]) + rng.uniform(-0.3, 0.3, (25, 3))
    tilted = Rotation.from_rotvec(rng.normal(0, 0.5, (25, 3)))
    first = Rotation.from_euler("x", 3.0)
    about_z = Rotation.from_rotvec(np.outer(rng.uniform(-1.5, 1.5, 25), [0, 0, 1]))
    flips = Rotation.from_rotvec(np.outer(np.arange(25) % 2 * np.pi, [0, 1, 0]))
    return {
        "translation": (
            pose(Rotation.concatenate([first] * 25), positions),
            "pure translation: the gripper hardly turned .* turn the wrist",
        ),
        "rotation": (
            pose(tilted * first, np.tile(positions[0], (25, 1))),
            "pure rotation: .* turned on the spot .* move the gripper by 10 cm",
        ),
        "one axis": (
            pose(about_z * first, positions),
            "parallel axes: .* about one axis only .* tilt the gripper",
        ),
        "half turns about one axis": (pose(flips, positions), "parallel axes"),
    }


@pytest.mark.parametrize(
    ("mount", "noise"), [("eye_in_hand", 0.0), ("eye_to_hand", 1.0)]
)
@pytest.mark.parametrize("name", degenerate_motions())
@pytest.mark.parametrize("scale_known", [True, False])
def test_degenerate_motions_are_refused(
    mount: MountName, noise: float, name: str, scale_known: bool
) -> None:
    robot, message = degenerate_motions()[name]
    pairs = pairs_of(robot, mount, noise)
    # A pan-tilt head; the size of its board is stated.
    if name == "rotation" and scale_known:
        truth = recording(
            replace(EXACT, mount=mount, path="table"), 0
        ).parent_from_camera
        calibration = solve(pairs, mount)
        assert calibration.uncertain_pose.squared_mahalanobis(truth) < 16.8
        assert (
            not noise
            or "turned about one point" in calibration.checks.to_dict()["warnings"][0]
        )
        return
    with pytest.raises(InputError, match=message):
        solve(pairs, mount, scale_known)


def test_an_outlier_is_not_a_second_axis() -> None:
    pairs = pairs_of(degenerate_motions()["one axis"][0], "eye_in_hand", 1.0)
    robot = pairs.base_from_gripper
    outlier = robot[-1] @ SE3.exp([0.1, 0, 0, 0.6, 0.3, 0.0])
    with pytest.raises(InputError, match="parallel axes"):
        solve(
            replace(pairs, base_from_gripper=SE3.stack([*robot[:-1], outlier])),
            "eye_in_hand",
        )


@pytest.mark.parametrize("distance_m", [0.5, 0.0])
def test_poses_on_a_sphere_about_the_board_require_a_known_scale(
    distance_m: float,
) -> None:
    # All motions rotate about the board. At distance zero its scale changes no residual.
    rotation = Rotation.from_rotvec(np.random.default_rng(3).normal(0, 0.5, (25, 3)))
    camera = pose(rotation, np.tile([0, 0, distance_m], (25, 1)))
    truth = recording(EXACT, 0)
    robot = truth.fixed_from_board @ (truth.parent_from_camera @ camera).inverse()
    pairs = PosePairs(truth.pairs.names, robot, camera)
    calibration = solve(pairs, "eye_in_hand")
    assert (
        np.abs(error(calibration.parent_from_child, truth.parent_from_camera)).max()
        < 1e-6
    )
    with pytest.raises(
        InputError, match=r"pure rotation: .* leave the camera's scale open"
    ):
        solve(pairs, "eye_in_hand", scale_known=False)


def robot_by(change: Callable[[SE3], SE3]) -> Mistake:
    return lambda pairs: replace(
        pairs, base_from_gripper=change(pairs.base_from_gripper)
    )


def camera_by(change: Callable[[SE3], SE3]) -> Mistake:
    return lambda pairs: replace(
        pairs, camera_from_board=change(pairs.camera_from_board)
    )


def scaled(factor: float, rows: slice = slice(None)) -> Callable[[SE3], SE3]:
    def change(poses: SE3) -> SE3:
        translation = poses.translation_m.copy()
        translation[rows] *= factor
        return SE3(poses.rotation_wxyz, translation)

    return change


def transposed(poses: SE3) -> SE3:
    return pose(rotations(poses).inv(), poses.translation_m)


def one_list(change: Callable[[SE3], SE3]) -> Mistake:
    noise = Setting(noise_mm=1.0, noise_deg=0.1)
    return lambda p: replace(
        p,
        base_from_gripper=change(
            shaken(p.camera_from_board, noise, np.random.default_rng(0))
        ),
    )


def shifted_from(row: int) -> Callable[[SE3], SE3]:
    return lambda poses: poses[np.minimum(np.arange(25) + (np.arange(25) >= row), 24)]


UNUSUAL: dict[str, tuple[Mistake, str]] = {
    "one list": (one_list(lambda p: p), "are one list"),
    "one list in mm": (one_list(scaled(1000)), "are one list"),
    "one inverted list": (one_list(SE3.inverse), "are one list"),
    "robot shifted from row 12": (
        robot_by(shifted_from(11)),
        "shifted by one from row 12 on",
    ),
    "camera shifted from row 20": (
        camera_by(shifted_from(18)),
        "shifted by one from row 19 on",
    ),
    "two poses": (lambda p: p[np.arange(2)], "^2 pose pairs; .* at least 5"),
    "one pose": (lambda p: p[np.arange(1)], "^1 pose pair; "),
    "duplicates": (
        lambda p: p[np.arange(25) % 3],
        "25 pose pairs hold only 3 different ones",
    ),
    "camera in cm": (camera_by(scaled(100)), "the camera poses look like another unit"),
    "some rows in mm": (
        robot_by(scaled(1000, slice(3, 9))),
        "the robot poses mix units: row 4, row 5, row 6, row 7, row 8 and 1 more",
    ),
    "robot transposed": (robot_by(transposed), "look transposed|`robot_convention`"),
    "shuffled rows": (
        lambda p: replace(
            p, camera_from_board=p.camera_from_board[np.arange(25) * 7 % 25]
        ),
        "rotations .* inconsistent: from row .* no other reading .* each row belongs to its image",
    ),
    "stale robot": (
        robot_by(lambda p: p[np.zeros(25, dtype=int)]),
        "robot's pose is the same in every row",
    ),
    "frozen camera": (
        camera_by(lambda p: p[np.zeros(25, dtype=int)]),
        "board's pose is the same in every image",
    ),
}


@pytest.mark.parametrize("name", UNUSUAL)
def test_mistakes_are_diagnosed(name: str) -> None:
    mistake, expected = UNUSUAL[name]
    in_hand = len(name) % 2 == 0
    mount: MountName = "eye_in_hand" if in_hand else "eye_to_hand"
    path = "table" if in_hand else "random"
    with pytest.raises(InputError) as caught:
        solve(mistake(recording(Setting(mount, path=path), 7).pairs), mount)
    message = str(caught.value)
    assert "\n" not in message
    assert re.search(expected, message), message


@pytest.mark.parametrize("name", MISTAKES)
def test_usual_mistakes_are_named(name: str) -> None:
    mistake, expected = MISTAKES[name]
    mount = MOUNTS[len(name) % 2]
    pairs = pose_pairs(record(BoardSetting(mount), 3), 3)
    solve(pairs, mount)
    with pytest.raises(InputError, match=expected):
        solve(mistake(pairs), OTHER[mount] if name == "other mount" else mount)


@pytest.mark.parametrize("mount", MOUNTS)
def test_a_wrong_size_of_the_squares_is_named_and_estimated(mount: MountName) -> None:
    truth = recording(Setting(mount, path="table"), 7)
    pairs = camera_by(scaled(1.05))(truth.pairs)
    calibration = solve(pairs, mount)
    [warning] = calibration.checks.to_dict()["warnings"]
    assert re.search(
        r"4\.\d+ \+- .* smaller .* 22\.\d\d mm|5\.\d+ \+- .* 22\.\d\d mm", warning
    )
    distance = calibration.uncertain_pose.squared_mahalanobis(truth.parent_from_camera)
    assert distance < 16.8


def test_a_misspelt_mount_is_refused() -> None:
    mount: Any = "wrist"
    pairs = recording(EXACT, 0).pairs
    message = "^mount 'wrist': give eye_to_hand or eye_in_hand$"
    with pytest.raises(InputError, match=message):
        solve(pairs, mount)


def test_mirrored_images_are_named() -> None:
    truth = recording(replace(EXACT, path="table"), 0)
    camera = truth.pairs.camera_from_board
    mirror = np.diag([-1.0, 1.0, 1.0])
    rotation = Rotation.from_matrix(mirror @ camera.rotation_matrix() @ mirror)
    mirrored = pose(rotation, camera.translation_m @ mirror)
    pairs = replace(truth.pairs, camera_from_board=mirrored)
    with pytest.raises(InputError, match="only mirrored: switch the mirror"):
        solve(pairs, "eye_in_hand")
