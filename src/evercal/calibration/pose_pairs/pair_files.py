"""Read pose pairs from a file of robot poses and a file of camera poses."""

import json
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.boards.board_poses import FORMAT, BoardPoses, read_board_poses
from evercal.calibration.pose_pairs.measured import BoardCorners
from evercal.calibration.pose_pairs.pairs import PoseNumbers, PosePairs
from evercal.calibration.pose_pairs.time_offset import CameraTrack, interpolated_pairs
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.poses.conventions import PoseConvention
from evercal.recordings.poses.pose_track import PoseTrack
from evercal.recordings.poses.robot_poses import RobotPoses, read_robot_poses
from evercal.recordings.poses.row_files import natural_key, times_in_names, without_ending

Inverted = Literal["robot", "camera", "both"]


@dataclass(frozen=True)
class PairFiles:
    """Files of pose pairs and their conventions."""

    robot: Path
    """base_from_gripper: a table, JSON, NPY, NPZ or TUM."""
    camera: Path
    """camera_from_board: the file of `evercal detect`, or a file like that of the robot."""
    robot_convention: str | None = None
    """Pose convention of a file without a header."""
    camera_convention: str | None = None
    invert: Inverted | None = None
    """Files that hold inverted poses: gripper_from_base, board_from_camera."""


@dataclass(frozen=True, eq=False)
class _CameraPoses:
    """All images of a camera file."""

    names: tuple[str, ...] | None
    stamps_s: NDArray[np.float64] | None
    """(n,) times from the file or from the names."""
    poses: list[SE3 | None]
    """(n,) poses, or None if the image shows no board."""
    board: BoardPoses | None
    """The file of `evercal detect`."""
    numbers: NDArray[np.float64] | None = None
    """(n, k) numbers of a table."""
    convention: PoseConvention | None = None
    camera_from: bool = True
    """Whether the camera's frame is the first of a pose of the table."""

    def rows(self) -> tuple[str, ...]:
        """Return the image names, or the row numbers of a file without names."""
        return self.names or tuple(f"row {i + 1}" for i in range(len(self.poses)))


def read_pairs(files: PairFiles) -> tuple[PosePairs, BoardCorners | None]:
    """Read robot and camera poses and pair them.

    If both files have names, equal names are paired, without folder and suffix. Otherwise, if both
    have times, the robot poses are interpolated at the times of the images. Otherwise rows are
    paired in order; the images of `evercal detect` are sorted naturally (image-2 before image-10).

    Raises:
        InputError: A file is broken, or the poses cannot be paired.
    """
    robot, camera = _read_robot(files), _read_camera(files)
    if robot.names is not None and camera.names is not None:
        rows = _rows_by_name(files, robot.names, camera.names)
    elif robot.stamps_s is not None and camera.stamps_s is not None:
        track = PoseTrack(robot.stamps_s, robot.poses)
        pairs, overlapping = interpolated_pairs(track, _camera_track(camera))
        return pairs, overlapping.corners
    elif len(robot.poses) == len(camera.poses):
        rows = [*range(len(robot.poses))]
    else:
        raise InputError(
            f"{files.robot}: {len(robot.poses)} poses for {len(camera.poses)} images of"
            f" {files.camera}; give one row per image, or name the images in a column 'image'"
        )
    paired = [i for i, row in enumerate(rows) if row is not None and camera.poses[i] is not None]
    if not paired:
        raise InputError(f"{files.camera}: no image has both a board and a robot pose")
    names = camera.names or robot.names or camera.rows()
    pairs = PosePairs(
        tuple(names[i] for i in paired),
        robot.poses[np.array([rows[i] for i in paired], dtype=np.int64)],
        SE3.stack([pose for i in paired if (pose := camera.poses[i]) is not None]),
        robot_numbers=_numbers(robot.numbers, robot.convention, [rows[i] or 0 for i in paired]),
        camera_numbers=_numbers(camera.numbers, camera.convention, paired, camera.camera_from),
    )
    return pairs, _corners(camera.board, paired)


def read_streams(files: PairFiles) -> tuple[PoseTrack, CameraTrack]:
    """Read robot and camera poses with times of separate clocks, or raise InputError."""
    robot, camera = _read_robot(files), _read_camera(files)
    if robot.stamps_s is None:
        raise InputError(f"{files.robot}: has no times; --time-offset takes a column stamp_s")
    if camera.stamps_s is None:
        raise InputError(
            f"{files.camera}: has no times; --time-offset takes a column stamp_s, or images named"
            f" after their time in seconds"
        )
    return PoseTrack(robot.stamps_s, robot.poses), _camera_track(camera)


def _read_robot(files: PairFiles) -> RobotPoses:
    robot = _read_poses(files.robot, "robot", files.robot_convention)
    if files.invert in ("robot", "both"):
        convention = _inverted(robot.convention)
        robot = replace(robot, poses=robot.poses.inverse(), convention=convention)
    return robot


def _inverted(convention: PoseConvention | None) -> PoseConvention | None:
    """Return the convention of the same numbers that states the inverse."""
    if convention is None:
        return None
    words = convention.name.split(":")
    words = [w for w in words if w != "inverse"] if "inverse" in words else [*words, "inverse"]
    return replace(convention, name=":".join(words))


def _numbers(
    numbers: NDArray[np.float64] | None,
    convention: PoseConvention | None,
    rows: list[int],
    camera_from: bool = False,
) -> PoseNumbers | None:
    if numbers is None or convention is None:
        return None
    return PoseNumbers(numbers[rows], convention, camera_from)


def _read_camera(files: PairFiles) -> _CameraPoses:
    if _is_board_file(files.camera):
        board = read_board_poses(files.camera)
        images = sorted(board.images, key=lambda image: natural_key(PurePath(image.name).name))
        names = tuple(image.name for image in images)
        poses = [image.camera_from_board for image in images]
        board = replace(board, images=tuple(images))
        camera = _CameraPoses(names, times_in_names(names), poses, board)
    else:
        # Inverted, the file states board_from_camera.
        camera_from = files.invert not in ("camera", "both")
        table = _read_poses(files.camera, "camera", files.camera_convention, camera_from)
        stamps = table.stamps_s
        if stamps is None and table.names is not None:
            stamps = times_in_names(table.names)
        poses: list[SE3 | None] = [*table.poses]
        numbers = table.numbers
        camera = _CameraPoses(
            table.names, stamps, poses, None, numbers, table.convention, camera_from
        )
    if files.invert not in ("camera", "both"):
        return camera
    inverse = [p if p is None else p.inverse() for p in camera.poses]
    return replace(camera, poses=inverse, convention=_inverted(camera.convention), camera_from=True)


def _read_poses(
    path: Path, role: str, convention: str | None, camera_from: bool = False
) -> RobotPoses:
    """Read a table of poses; messages name its role and its own option."""
    if not path.exists():
        raise InputError(f"{path}: file of {role} poses is missing; check --{role}-poses")
    return read_robot_poses(
        path,
        convention,
        what=f"file of {role} poses",
        option=f"--{role}-convention",
        camera_from=camera_from,
    )


def _is_board_file(path: Path) -> bool:
    if path.suffix.lower() != ".json":
        return False
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False  # read_robot_poses reports the error
    return isinstance(data, dict) and data.get("format") == FORMAT


def _rows_by_name(
    files: PairFiles, robot: tuple[str, ...], camera: tuple[str, ...]
) -> list[int | None]:
    row_of = {without_ending(name): i for i, name in enumerate(robot)}
    repeated = [name for i, name in enumerate(robot) if row_of[without_ending(name)] != i]
    if repeated:
        raise InputError(
            f"{files.robot}: {repeated[0]!r} comes twice, apart from folder and suffix; give every"
            f" image a unique name"
        )
    rows = [row_of.get(without_ending(name)) for name in camera]
    if all(row is None for row in rows):
        raise InputError(
            f"{files.robot}: names no image of {files.camera}; its first is {robot[0]!r}, the first"
            f" image is {camera[0]!r}"
        )
    return rows


def _camera_track(camera: _CameraPoses) -> CameraTrack:
    assert camera.stamps_s is not None
    detected = [i for i, pose in enumerate(camera.poses) if pose is not None]
    names = camera.rows()
    return CameraTrack(
        tuple(names[i] for i in detected),
        camera.stamps_s[detected],
        SE3.stack([pose for pose in camera.poses if pose is not None]),
        _corners(camera.board, detected),
    )


def _corners(board: BoardPoses | None, rows: list[int]) -> BoardCorners | None:
    if board is None:
        return None
    views = tuple(view for i in rows if (view := board.images[i].view) is not None)
    stated = board.camera_from == "file"
    printed = board.board
    turns = printed.half_turn, printed.quarter_turn
    return BoardCorners(board.camera, views, *turns, stated, printed.size_m)
