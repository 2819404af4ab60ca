"""Recordings that do not determine a calibration, each refused with its own reason."""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.hand_eye import Setting, error, pose, recording, rotations, shaken
from evercal.calibration.calibration import Mount
from evercal.calibration.pose_pairs.pairs import PosePairs
from evercal.calibration.pose_pairs.solve import solve
from evercal.errors import InputError
from evercal.geometry import SE3

MOUNTS: tuple[Mount, ...] = ("eye_in_hand", "eye_to_hand")
EXACT = Setting(noise_mm=0, noise_deg=0)
Mistake = Callable[[PosePairs], PosePairs]


def pairs_of(robot: SE3, mount: Mount, noise: float) -> PosePairs:
    """Simulate the camera poses of given robot poses."""
    truth = recording(replace(EXACT, mount=mount), 0)
    fixed_from_parent = robot if mount == "eye_in_hand" else robot.inverse()
    camera = (fixed_from_parent @ truth.parent_from_camera).inverse() @ truth.fixed_from_board
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
            "pure translation: the gripper never turned .* turn the wrist",
        ),
        "rotation": (
            pose(tilted, np.tile(positions[0], (25, 1))),
            "pure rotation: .* turned on the spot .* move the gripper by 10 cm",
        ),
        "one axis": (
            pose(about_z * first, positions),
            "parallel axes: .* about one axis only .* tilt the gripper",
        ),
        "half turns about one axis": (pose(flips, positions), "parallel axes"),
    }


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("name", degenerate_motions())
@pytest.mark.parametrize("scale_known", [True, False])
def test_degenerate_motions_are_refused(
    mount: Mount, noise: float, name: str, scale_known: bool
) -> None:
    robot, message = degenerate_motions()[name]
    with pytest.raises(InputError, match=message):
        solve(pairs_of(robot, mount, noise), mount, scale_known)


def test_an_outlier_is_not_a_second_axis() -> None:
    pairs = pairs_of(degenerate_motions()["one axis"][0], "eye_in_hand", 1.0)
    robot = pairs.base_from_gripper
    outlier = robot[-1] @ SE3.exp([0.1, 0, 0, 0.6, 0.3, 0.0])
    with pytest.raises(InputError, match="parallel axes"):
        solve(replace(pairs, base_from_gripper=SE3.stack([*robot[:-1], outlier])), "eye_in_hand")


@pytest.mark.parametrize("distance_m", [0.5, 0.0])
def test_poses_on_a_sphere_about_the_board_require_a_known_scale(distance_m: float) -> None:
    # All motions rotate about the board. At distance zero its scale changes no residual.
    rotation = Rotation.from_rotvec(np.random.default_rng(3).normal(0, 0.5, (25, 3)))
    camera = pose(rotation, np.tile([0, 0, distance_m], (25, 1)))
    truth = recording(EXACT, 0)
    robot = truth.fixed_from_board @ (truth.parent_from_camera @ camera).inverse()
    pairs = PosePairs(truth.pairs.names, robot, camera)
    calibration = solve(pairs, "eye_in_hand")
    assert np.abs(error(calibration.parent_from_child, truth.parent_from_camera)).max() < 1e-6
    with pytest.raises(InputError, match=r"pure rotation: .* leave the camera's scale open"):
        solve(pairs, "eye_in_hand", scale_known=False)


def robot_by(change: Callable[[SE3], SE3]) -> Mistake:
    return lambda pairs: replace(pairs, base_from_gripper=change(pairs.base_from_gripper))


def camera_by(change: Callable[[SE3], SE3]) -> Mistake:
    return lambda pairs: replace(pairs, camera_from_board=change(pairs.camera_from_board))


def scaled(factor: float, rows: slice = slice(None)) -> Callable[[SE3], SE3]:
    def change(poses: SE3) -> SE3:
        translation = poses.translation_m.copy()
        translation[rows] *= factor
        return SE3(poses.rotation_wxyz, translation)

    return change


def misread(used: str, meant: str) -> Callable[[SE3], SE3]:
    return lambda poses: pose(
        Rotation.from_euler(used, rotations(poses).as_euler(meant)), poses.translation_m
    )


def transposed(poses: SE3) -> SE3:
    return pose(rotations(poses).inv(), poses.translation_m)


def wxyz_as_xyzw(poses: SE3) -> SE3:
    return SE3(poses.rotation_wxyz[:, [3, 0, 1, 2]], poses.translation_m)


MISTAKES: dict[str, tuple[Mistake, str]] = {
    "two poses": (lambda p: p[np.arange(2)], "^2 pose pairs; .* at least 5"),
    "one pose": (lambda p: p[np.arange(1)], "^1 pose pair; "),
    "duplicates": (lambda p: p[np.arange(25) % 3], "25 pose pairs hold only 3 different ones"),
    "robot in mm": (robot_by(scaled(1000)), "the robot poses look like millimetres"),
    "camera in mm": (camera_by(scaled(1000)), "the camera poses look like millimetres"),
    "camera in cm": (camera_by(scaled(100)), "the camera poses look like another unit"),
    "some rows in mm": (
        robot_by(scaled(1000, slice(3, 9))),
        "the robot poses mix units: row 4, row 5, row 6, row 7, row 8 and 1 more",
    ),
    "wrong squares": (
        camera_by(scaled(1.05)),
        "lengths .* the scale with --scale unknown",
    ),
    "robot inverted": (robot_by(lambda p: p.inverse()), "robot poses look inverted"),
    "camera inverted": (camera_by(lambda p: p.inverse()), "invert the camera|--invert camera"),
    "robot transposed": (robot_by(transposed), "rotations of the robot poses look transposed"),
    "xyz for ZYX": (robot_by(misread("xyz", "ZYX")), "robot angles .* xyz and ZYX seem mixed"),
    "XYZ for xyz": (robot_by(misread("XYZ", "xyz")), "robot angles .* Euler order"),
    "ZYX for XYZ": (camera_by(misread("ZYX", "XYZ")), "camera angles .* Euler order"),
    "quaternion order": (robot_by(wxyz_as_xyzw), "robot quaternions look read in the order"),
    "shifted rows": (
        lambda p: replace(p[np.arange(24)], camera_from_board=p.camera_from_board[1:]),
        "rows and images are shifted by one",
    ),
    "shuffled rows": (
        lambda p: replace(p, camera_from_board=p.camera_from_board[np.arange(25) * 7 % 25]),
        "agree in no rotation: from row .* check that each row belongs to its image",
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
AMBIGUOUS = ("quaternion order", "XYZ for xyz", "ZYX for XYZ", "robot transposed")
"""Mistakes for which another reading may fit equally well."""


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("path", ["random", "table"])
@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_diagnosed(mount: Mount, path: str, name: str) -> None:
    mistake, expected = MISTAKES[name]
    with pytest.raises(InputError) as caught:
        solve(mistake(recording(Setting(mount, path=path), 7).pairs), mount)
    message = str(caught.value)
    assert "\n" not in message
    assert re.search("agree" if name in AMBIGUOUS else expected, message), message


@pytest.mark.parametrize("mount", MOUNTS)
def test_the_other_mount_is_suggested(mount: Mount) -> None:
    other: Mount = "eye_to_hand" if mount == "eye_in_hand" else "eye_in_hand"
    with pytest.raises(InputError, match=f"--mount {mount}"):
        solve(recording(Setting(mount, path="table"), 8).pairs, other)


def test_a_board_behind_the_camera_gives_a_warning() -> None:
    truth = recording(EXACT, 10)
    camera = truth.pairs.camera_from_board
    behind = pose(rotations(camera), np.array([0, 0, -0.5]) + 0.2 * camera.translation_m)
    robot = truth.fixed_from_board @ (truth.parent_from_camera @ behind).inverse()
    calibration = solve(PosePairs(truth.pairs.names, robot, behind), "eye_in_hand")
    assert any("behind the camera" in warning for warning in calibration.checks["warnings"])


def test_two_inverted_files_give_a_warning() -> None:
    # Inverted robot and camera poses obey the same equation with swapped unknowns.
    truth = recording(EXACT, 12)
    inverted = replace(
        truth.pairs,
        base_from_gripper=truth.pairs.base_from_gripper.inverse(),
        camera_from_board=truth.pairs.camera_from_board.inverse(),
    )
    assert np.linalg.norm(truth.fixed_from_board.translation_m) > 0.4
    warnings = solve(inverted, "eye_in_hand").checks["warnings"]
    assert any("both robot and camera poses are inverted" in warning for warning in warnings)
