"""Pose pairs from two files: robot poses and camera poses, paired by name, by time or in order."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.boards.board_poses import FORMAT, BoardPoses, read_board_poses
from evercal.calibration.pose_pairs.pairs import PosePairs
from evercal.calibration.pose_pairs.solve import BoardCorners
from evercal.calibration.pose_pairs.time_offset import CameraTrack, interpolated_pairs
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.poses.pose_track import PoseTrack
from evercal.recordings.poses.robot_poses import RobotPoses, read_robot_poses
from evercal.recordings.poses.row_files import natural_key, times_in_names, without_ending

Inverted = Literal["robot", "camera", "both"]


@dataclass(frozen=True)
class PairFiles:
    """Two files and how they are written."""

    robot: Path
    """base_from_gripper: CSV, JSON, NPY or TUM."""
    camera: Path
    """camera_from_board: what `evercal detect` wrote, or a file like that of the robot."""
    robot_convention: str | None = None
    """How the robot's numbers are meant, where the file does not say it."""
    camera_convention: str | None = None
    """The same of a camera file that `evercal detect` did not write."""
    invert: Inverted | None = None
    """Whose poses the files hold inverted: gripper_from_base, board_from_camera."""


@dataclass(frozen=True, eq=False)
class _CameraPoses:
    """The images of a camera file, those without a board among them."""

    names: tuple[str, ...] | None
    """(n,) unless the file has none."""
    stamps_s: NDArray[np.float64] | None
    """(n,) where the file, or every name, says it."""
    poses: list[SE3 | None]
    """(n,), None where there is no board."""
    board: BoardPoses | None
    """The file, where `evercal detect` wrote it."""


def read_pairs(files: PairFiles) -> tuple[PosePairs, BoardCorners | None]:
    """Reads robot and camera poses that belong together.

    Where both files have names, equal names (without folder and ending) go together; else, where
    both have times, robot poses are interpolated at those of the images; else rows and images are
    as many and go together in order, the images of `evercal detect` in natural order of their
    names (image-2 before image-10).

    Raises:
        InputError: A file is broken, or they cannot be paired.
    """
    robot, camera = _robot(files), _camera(files)
    if robot.names is not None and camera.names is not None:
        rows = _rows_by_name(files, robot.names, camera.names)
    elif robot.stamps_s is not None and camera.stamps_s is not None:
        track = PoseTrack(robot.stamps_s, robot.poses)
        pairs, seen = interpolated_pairs(track, _track(camera))
        return pairs, seen.corners
    else:
        rows = _rows_in_order(files, robot, camera)
    seen = [i for i, row in enumerate(rows) if row is not None and camera.poses[i] is not None]
    if not seen:
        raise InputError(f"{files.camera}: no image of it has both a board and a robot pose")
    names = camera.names or robot.names or tuple(f"row {i + 1}" for i in range(len(rows)))
    pairs = PosePairs(
        tuple(names[i] for i in seen),
        robot.poses[np.array([rows[i] for i in seen], dtype=np.int64)],
        SE3.stack([pose for i in seen if (pose := camera.poses[i]) is not None]),
    )
    return pairs, _corners(camera.board, seen)


def read_streams(files: PairFiles) -> tuple[PoseTrack, CameraTrack]:
    """Reads robot and camera poses with times of their own clocks.

    Raises:
        InputError: A file is broken or has no times.
    """
    robot, camera = _robot(files), _camera(files)
    if robot.stamps_s is None:
        raise InputError(f"{files.robot}: has no times; --time-offset takes a column stamp_s")
    if camera.stamps_s is None:
        raise InputError(
            f"{files.camera}: has no times; --time-offset takes a column stamp_s, or images named"
            f" after their time in seconds"
        )
    return PoseTrack(robot.stamps_s, robot.poses), _track(camera)


def _robot(files: PairFiles) -> RobotPoses:
    found = read_robot_poses(files.robot, files.robot_convention, option="--robot-convention")
    if files.invert in ("robot", "both"):
        found = replace(found, poses=found.poses.inverse())
    return found


def _camera(files: PairFiles) -> _CameraPoses:
    if _is_board_file(files.camera):
        board = read_board_poses(files.camera)
        natural = sorted(board.images, key=lambda image: natural_key(image.name))
        board = replace(board, images=tuple(natural))
        names = tuple(image.name for image in board.images)
        poses = [image.camera_from_board for image in board.images]
        found = _CameraPoses(names, times_in_names(names), poses, board)
    else:
        read = read_robot_poses(
            files.camera,
            files.camera_convention,
            what="camera file",
            option="--camera-convention",
        )
        stamps = read.stamps_s
        if stamps is None and read.names is not None:
            stamps = times_in_names(read.names)
        found = _CameraPoses(read.names, stamps, list(read.poses), None)
    if files.invert not in ("camera", "both"):
        return found
    return replace(found, poses=[p if p is None else p.inverse() for p in found.poses])


def _is_board_file(path: Path) -> bool:
    if path.suffix.lower() != ".json":
        return False
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False  # the reader of poses says what is wrong with it
    return isinstance(data, dict) and data.get("format") == FORMAT


def _rows_by_name(
    files: PairFiles, robot: tuple[str, ...], camera: tuple[str, ...]
) -> list[int | None]:
    where = {without_ending(name): i for i, name in enumerate(robot)}
    twice = [n for i, n in enumerate(robot) if where[without_ending(n)] != i]
    if twice:
        raise InputError(
            f"{files.robot}: {twice[0]!r} comes twice, apart from folder and ending; give every"
            f" image a name of its own"
        )
    rows = [where.get(without_ending(name)) for name in camera]
    if all(row is None for row in rows):
        raise InputError(
            f"{files.robot}: names no image of {files.camera}; its first is {robot[0]!r}, the first"
            f" image is {camera[0]!r}"
        )
    return rows


def _rows_in_order(files: PairFiles, robot: RobotPoses, camera: _CameraPoses) -> list[int | None]:
    if len(robot.poses) != len(camera.poses):
        raise InputError(
            f"{files.robot}: {len(robot.poses)} poses for {len(camera.poses)} images of"
            f" {files.camera}; give every image its row, or name the images in a column 'image'"
        )
    return list(range(len(robot.poses)))


def _track(camera: _CameraPoses) -> CameraTrack:
    assert camera.stamps_s is not None
    seen = [i for i, pose in enumerate(camera.poses) if pose is not None]
    names = camera.names or tuple(f"row {i + 1}" for i in range(len(camera.poses)))
    return CameraTrack(
        tuple(names[i] for i in seen),
        camera.stamps_s[seen],
        SE3.stack([pose for pose in camera.poses if pose is not None]),
        _corners(camera.board, seen),
    )


def _corners(board: BoardPoses | None, seen: list[int]) -> BoardCorners | None:
    if board is None:
        return None
    views = tuple(view for i in seen if (view := board.images[i].view) is not None)
    return BoardCorners(board.camera, views, board.board.half_turn)
