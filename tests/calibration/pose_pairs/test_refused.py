"""Recordings that cannot give an answer: each is refused with its own reason, none answered."""

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
Spoil = Callable[[PosePairs], PosePairs]


def from_robot(robot: SE3, mount: Mount, noise: float) -> PosePairs:
    """Pairs of a true recording whose robot moved in this way."""
    drawn = recording(Setting(mount, noise_mm=0, noise_deg=0), 0)
    fixed_from_parent = robot if mount == "eye_in_hand" else robot.inverse()
    seen = (fixed_from_parent @ drawn.parent_from_camera).inverse() @ drawn.fixed_from_board
    rng = np.random.default_rng(1)
    seen = shaken(seen, Setting(noise_mm=2 * noise, noise_deg=0.2 * noise), rng)
    return PosePairs(tuple(f"row {i + 1}" for i in range(len(robot))), robot, seen)


def robots() -> dict[str, tuple[SE3, str]]:
    rng = np.random.default_rng(2)
    places = np.array([0.5, 0, 0.5]) + rng.uniform(-0.3, 0.3, (25, 3))
    turns = Rotation.from_rotvec(rng.normal(0, 0.5, (25, 3)))
    first = Rotation.from_euler("x", 3.0)
    about_z = Rotation.from_rotvec(np.outer(rng.uniform(-1.5, 1.5, 25), [0, 0, 1]))
    return {
        "translation": (
            pose(Rotation.concatenate([first] * 25), places),
            "pure translation: the gripper never turned .* turn the wrist",
        ),
        "rotation": (
            pose(turns, np.tile(places[0], (25, 1))),
            "pure rotation: .* turned on the spot .* move the gripper by 10 cm",
        ),
        "one axis": (
            pose(about_z * first, places),
            "parallel axes: .* about one axis only .* tilt the gripper",
        ),
        "half turns about one axis": (
            pose(Rotation.from_rotvec(np.outer(np.arange(25) % 2 * np.pi, [0, 1, 0])), places),
            "parallel axes",
        ),
    }


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("name", robots())
@pytest.mark.parametrize("known", [True, False])
def test_motions_that_leave_it_open(mount: Mount, noise: float, name: str, known: bool) -> None:
    robot, reason = robots()[name]
    with pytest.raises(InputError, match=reason):
        solve(from_robot(robot, mount, noise), mount, known)


def test_one_outlier_does_not_make_a_second_axis() -> None:
    robot, _ = robots()["one axis"]
    pairs = from_robot(robot, "eye_in_hand", 1.0)
    stray = SE3.exp([0.1, 0, 0, 0.6, 0.3, 0.0])
    wrong = SE3.stack([*pairs.base_from_gripper[:-1], pairs.base_from_gripper[-1] @ stray])
    with pytest.raises(InputError, match="parallel axes"):
        solve(replace(pairs, base_from_gripper=wrong), "eye_in_hand")


@pytest.mark.parametrize("distance_m", [0.5, 0.0])
def test_a_sphere_about_the_board_does_with_a_known_scale_alone(distance_m: float) -> None:
    # All motions turn about the board: the camera's lengths tie nothing, as on a hemisphere. At no
    # distance their scale moves no residual at all.
    rng = np.random.default_rng(3)
    turn = Rotation.from_rotvec(rng.normal(0, 0.5, (25, 3)))
    seen = pose(turn, np.tile([0, 0, distance_m], (25, 1)))
    drawn = recording(Setting(noise_mm=0, noise_deg=0), 0)
    robot = drawn.fixed_from_board @ (drawn.parent_from_camera @ seen).inverse()
    pairs = PosePairs(drawn.pairs.names, robot, seen)
    found = solve(pairs, "eye_in_hand")
    assert np.abs(error(found.parent_from_child, drawn.parent_from_camera)).max() < 1e-6
    with pytest.raises(InputError, match=r"pure rotation: .* leave the camera's scale open"):
        solve(pairs, "eye_in_hand", scale_known=False)


def changed_robot(change: Callable[[SE3], SE3]) -> Spoil:
    return lambda pairs: replace(pairs, base_from_gripper=change(pairs.base_from_gripper))


def changed_camera(change: Callable[[SE3], SE3]) -> Spoil:
    return lambda pairs: replace(pairs, camera_from_board=change(pairs.camera_from_board))


def scaled(factor: float) -> Callable[[SE3], SE3]:
    return lambda poses: SE3(poses.rotation_wxyz, factor * poses.translation_m)


def misread(used: str, meant: str) -> Callable[[SE3], SE3]:
    return lambda poses: pose(
        Rotation.from_euler(used, rotations(poses).as_euler(meant)), poses.translation_m
    )


def some_in_millimetres(poses: SE3) -> SE3:
    translation = poses.translation_m.copy()
    translation[3:9] *= 1000
    return SE3(poses.rotation_wxyz, translation)


def transposed(poses: SE3) -> SE3:
    return pose(rotations(poses).inv(), poses.translation_m)


def wxyz_as_xyzw(poses: SE3) -> SE3:
    return SE3(poses.rotation_wxyz[:, [3, 0, 1, 2]], poses.translation_m)


MISTAKES: dict[str, tuple[Spoil, str]] = {
    "two poses": (lambda p: p[np.arange(2)], "^2 pose pairs; .* at least 5"),
    "one pose": (lambda p: p[np.arange(1)], "^1 pose pair; "),
    "duplicates": (lambda p: p[np.arange(25) % 3], "25 pose pairs hold only 3 different ones"),
    "robot in mm": (changed_robot(scaled(1000)), "the robot poses look like millimetres"),
    "camera in mm": (changed_camera(scaled(1000)), "the camera poses look like millimetres"),
    "camera in cm": (changed_camera(scaled(100)), "the camera poses look like another unit"),
    "some rows in mm": (
        changed_robot(some_in_millimetres),
        "the robot poses mix units: row 4, row 5, row 6, row 7, row 8 and 1 more",
    ),
    "wrong squares": (changed_camera(scaled(1.05)), "camera's lengths .* or say --scale unknown"),
    "robot inverted": (changed_robot(lambda p: p.inverse()), "robot poses look inverted"),
    "camera inverted": (changed_camera(lambda p: p.inverse()), "invert the camera|--invert camera"),
    "robot transposed": (changed_robot(transposed), "rotations of the robot poses look transposed"),
    "xyz for ZYX": (changed_robot(misread("xyz", "ZYX")), "robot angles .* xyz and ZYX seem mixed"),
    "XYZ for xyz": (changed_robot(misread("XYZ", "xyz")), "robot angles .* Euler order"),
    "ZYX for XYZ": (changed_camera(misread("ZYX", "XYZ")), "camera angles .* Euler order"),
    "quaternion order": (changed_robot(wxyz_as_xyzw), "robot quaternions look read in the order"),
    "shifted rows": (
        lambda p: replace(p[np.arange(24)], camera_from_board=p.camera_from_board[1:]),
        "rows and images are shifted by one",
    ),
    "shuffled rows": (
        lambda p: replace(p, camera_from_board=p.camera_from_board[np.arange(25) * 7 % 25]),
        "agree in no rotation: from row .* check that each row belongs to its image",
    ),
    "stale robot": (
        lambda p: replace(p, base_from_gripper=p.base_from_gripper[np.zeros(25, dtype=int)]),
        "robot's pose is the same in every row",
    ),
    "frozen camera": (
        lambda p: replace(p, camera_from_board=p.camera_from_board[np.zeros(25, dtype=int)]),
        "board's pose is the same in every image",
    ),
}


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("path", ["random", "table"])
@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_named(mount: Mount, path: str, name: str) -> None:
    spoil, reason = MISTAKES[name]
    pairs = spoil(recording(Setting(mount, path=path), 7).pairs)
    with pytest.raises(InputError) as caught:
        solve(pairs, mount)
    message = str(caught.value)
    assert "\n" not in message
    if name in ("quaternion order", "XYZ for xyz", "ZYX for XYZ", "robot transposed"):
        # Another reading may turn the camera or the board alike; then that one is named.
        assert "agree" in message
    else:
        assert re.search(reason, message), message


@pytest.mark.parametrize("mount", MOUNTS)
def test_the_other_mount_is_named(mount: Mount) -> None:
    other: Mount = "eye_to_hand" if mount == "eye_in_hand" else "eye_in_hand"
    pairs = recording(Setting(mount, path="table"), 8).pairs
    with pytest.raises(InputError, match=f"--mount {mount}"):
        solve(pairs, other)


def test_what_is_said_puts_it_right() -> None:
    drawn = recording(Setting("eye_in_hand", path="table"), 9)
    wrong = replace(drawn.pairs, base_from_gripper=drawn.pairs.base_from_gripper.inverse())
    with pytest.raises(InputError, match="--invert robot"):
        solve(wrong, "eye_in_hand")
    right = replace(wrong, base_from_gripper=wrong.base_from_gripper.inverse())
    found = solve(right, "eye_in_hand")
    assert np.linalg.norm(error(found.parent_from_child, drawn.parent_from_camera)[:3]) < 0.004


def test_a_board_behind_the_camera_is_doubted() -> None:
    drawn = recording(Setting(noise_mm=0, noise_deg=0), 10)
    turn = rotations(drawn.pairs.camera_from_board)
    seen = pose(turn, np.array([0, 0, -0.5]) + drawn.pairs.camera_from_board.translation_m * 0.2)
    robot = drawn.fixed_from_board @ (drawn.parent_from_camera @ seen).inverse()
    found = solve(PosePairs(drawn.pairs.names, robot, seen), "eye_in_hand")
    assert any("behind the camera" in sentence for sentence in found.checks["warnings"])


def test_swapped_roles_are_doubted() -> None:
    # Both inverted obey the same equation with the roles of both transforms exchanged.
    drawn = recording(Setting(noise_mm=0, noise_deg=0), 12)
    both = replace(
        drawn.pairs,
        base_from_gripper=drawn.pairs.base_from_gripper.inverse(),
        camera_from_board=drawn.pairs.camera_from_board.inverse(),
    )
    far = np.linalg.norm(drawn.fixed_from_board.translation_m)
    found = solve(both, "eye_in_hand")
    doubted = any("both inverted" in sentence for sentence in found.checks["warnings"])
    assert doubted == (far > 0.4)
    assert far > 0.4
