"""Read pose pairs from a file of robot poses and a file of camera poses."""

from dataclasses import replace
from pathlib import Path, PurePath
from typing import Literal

import numpy as np

from evercal.calibration.boards.board_poses import (
    FORMAT,
    BoardPoses,
    read_board_poses,
)
from evercal.calibration.pose_pairs.pairs import BoardCorners, PoseNumbers, PosePairs
from evercal.calibration.pose_pairs.time_offset import CameraTrack, interpolated_pairs
from evercal.classes import frozen, frozen_arrays
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.poses.conventions import PoseConvention
from evercal.recordings.poses.pairing import unpaired
from evercal.recordings.poses.pose_track import PoseTrack
from evercal.recordings.poses.robot_poses import read_robot_poses
from evercal.recordings.poses.row_files import (
    same_numbers,
    times_in_names,
    without_ending,
)
from evercal.storage.text_files import natural_key, read_json
from evercal.typing import Array, BoolArray, IntArray, Strings

Inverted = Literal["robot", "camera", "both"]


@frozen
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


@frozen_arrays
class PoseRows:
    """The n poses of a table, or of a file of `evercal detect`."""

    names: Strings | None
    stamps_s: Array | None
    """(n,) times from the file or from the names of images."""
    poses: SE3
    """(n,) poses; any for an image that shows no board."""
    measured: BoolArray
    """(n,) whether the image shows a board; true for a table."""
    numbers: PoseNumbers | None = None
    board: BoardPoses | None = None

    def row_names(self) -> Strings:
        """Names of images, or numbers of rows."""
        return self.names or tuple(f"row {i + 1}" for i in range(len(self.poses)))

    def corners_of(self, rows: IntArray) -> BoardCorners | None:
        """Corners of the images of rows, from a file of `evercal detect`."""
        if not self.board:
            return None
        views = []
        left_out = []
        for row in rows:
            image = self.board.images[row]
            if image.view is not None:
                views.append(image.view)
            for x, y in image.left_out:
                left_out.append(f"{image.name} {x:.0f} {y:.0f}")
        printed = self.board.board
        return BoardCorners(
            self.board.camera,
            tuple(views),
            half_turn=printed.half_turn,
            quarter_turn=printed.quarter_turn,
            stated=self.board.camera_from == "file",
            size_m=printed.size_m,
            board=printed,
            left_out=tuple(left_out),
        )


def read_pairs(files: PairFiles) -> tuple[PosePairs, BoardCorners | None]:
    """Read robot and camera poses and pair them.

    By names without folder and suffix if both files have them, else by times, else in order; the
    images of `evercal detect` are sorted naturally (image-2 before image-10).
    """
    robot = _read(files, "robot")
    camera = _read(files, "camera")
    notes: list[str] = []
    if robot.names is not None and camera.names is not None:
        rows, notes = _rows_by_name(files, robot.names, camera.names)
    elif robot.stamps_s is not None and camera.stamps_s is not None:
        pairs, overlapping = interpolated_pairs(*_streams(robot, camera))
        return pairs, overlapping.corners
    elif len(robot.poses) == len(camera.poses):
        rows = [*range(len(robot.poses))]
        names = camera.row_names()
        notes = [
            f"robot and camera poses were paired in order, {names[0]} to {names[-1]}"
        ]
    else:
        raise InputError(
            f"{files.robot}: {len(robot.poses)} poses for {len(camera.poses)} images of"
            f" {files.camera}; give one row per image, or name the images in a column 'image'"
        )
    shown = np.flatnonzero(camera.measured)
    images = np.array([i for i in shown if rows[i] is not None], np.int64)
    robots = np.array([rows[i] for i in images], np.int64)
    if len(images) == 0:
        raise InputError(f"{files.camera}: no image has both a board and a robot pose")
    names = camera.names or robot.row_names()
    pairs = PosePairs(
        tuple(names[i] for i in images),
        robot.poses[robots],
        camera.poses[images],
        robot_numbers=robot.numbers and robot.numbers[robots],
        camera_numbers=camera.numbers and camera.numbers[images],
        notes=tuple(notes),
    )
    return pairs, camera.corners_of(images)


def read_camera_poses(
    path: Path, convention: str | None = None, inverted: bool = False
) -> PoseRows:
    """Read camera_from_board of every row, or its inverse."""
    invert: Inverted | None = "camera" if inverted else None
    return _read(PairFiles(path, path, None, convention, invert), "camera")


def read_streams(files: PairFiles) -> tuple[PoseTrack, CameraTrack]:
    """Read robot and camera poses with times of separate clocks, or raise InputError."""
    robot = _read(files, "robot")
    camera = _read(files, "camera")
    if robot.stamps_s is None:
        raise InputError(
            f"{files.robot}: has no times; `time_offset` takes a column stamp_s"
        )
    if camera.stamps_s is None:
        raise InputError(
            f"{files.camera}: has no times; `time_offset` takes a column stamp_s, or images named"
            f" after their time in seconds"
        )
    return _streams(robot, camera)


def _streams(
    robot: PoseRows,
    camera: PoseRows,
) -> tuple[PoseTrack, CameraTrack]:
    assert robot.stamps_s is not None
    assert camera.stamps_s is not None
    rows = np.flatnonzero(camera.measured)
    names = camera.row_names()
    track = CameraTrack(
        tuple(names[row] for row in rows),
        camera.stamps_s[rows],
        camera.poses[rows],
        camera.corners_of(rows),
    )
    return PoseTrack(robot.stamps_s, robot.poses), track


def _read(
    files: PairFiles,
    role: Literal["robot", "camera"],
) -> PoseRows:
    """Read the poses of one file; messages name its role and its own option."""
    path = files.robot
    convention = files.robot_convention
    if role == "camera":
        path = files.camera
        convention = files.camera_convention
    if not path.exists():
        raise InputError(
            f"{path}: file of {role} poses is missing; check `{role}_poses`"
        )
    inverted = files.invert in (role, "both")
    if role == "camera" and _is_board_file(path):
        return _read_board_file(path, inverted)
    table = read_robot_poses(
        path,
        convention,
        what=f"file of {role} poses",
        option=f"`{role}_convention`",
        # Inverted, the file of the camera states board_from_camera.
        camera_from=role == "camera" and not inverted,
        robot=role == "robot",
    )
    poses = table.poses
    used = table.convention
    if inverted:
        poses = poses.inverse()
        used = used and _inverted(used)
    stamps = table.stamps_s
    if role == "camera" and stamps is None and table.names is not None:
        stamps = times_in_names(table.names)
    numbers = None
    if table.numbers is not None and used:
        numbers = PoseNumbers(
            table.numbers,
            used,
            camera_from=role == "camera",
        )
    return PoseRows(
        table.names,
        stamps,
        poses,
        np.ones(len(poses), bool),
        numbers,
    )


def _read_board_file(path: Path, inverted: bool) -> PoseRows:
    board = read_board_poses(path)
    if not board.images:
        raise InputError(f"{path}: holds no images; repeat evercal detect")
    images = sorted(
        board.images, key=lambda image: natural_key(PurePath(image.name).name)
    )
    names = tuple(image.name for image in images)
    measured = np.array([image.camera_from_board is not None for image in images])
    poses = SE3.stack([image.camera_from_board or SE3.identity() for image in images])
    if inverted:
        poses = poses.inverse()
    board = replace(board, images=tuple(images))
    return PoseRows(
        names,
        times_in_names(names),
        poses,
        measured,
        board=board,
    )


def _inverted(convention: PoseConvention) -> PoseConvention:
    words = convention.name.split(":")
    if "inverse" in words:
        words.remove("inverse")
    else:
        words.append("inverse")
    return replace(convention, name=":".join(words))


def _is_board_file(path: Path) -> bool:
    if path.suffix.lower() != ".json":
        return False
    try:
        return read_json(path, "poses").get("format") == FORMAT
    except InputError:
        return False  # read_robot_poses reports the error


def _rows_by_name(
    files: PairFiles, robot: Strings, camera: Strings
) -> tuple[list[int | None], list[str]]:
    row_of = {without_ending(name): i for i, name in enumerate(robot)}
    for i, name in enumerate(robot):
        if row_of[without_ending(name)] != i:
            raise InputError(
                f"{files.robot}: {name!r} comes twice, apart from folder and suffix; give every"
                f" image a unique name"
            )
    rows = [row_of.get(without_ending(name)) for name in camera]
    if not any(row is not None for row in rows):
        if same_numbers(robot, camera):
            note = f"paired by numbers: {robot[0]} with {camera[0]}, and so on"
            return [*range(len(camera))], [note]
        raise InputError(
            f"{files.robot}: names no image of {files.camera}; its first is {robot[0]!r}, the first"
            f" image is {camera[0]!r}"
        )
    alone = [camera[i] for i, row in enumerate(rows) if row is None]
    others = [robot[i] for i in sorted({*range(len(robot))} - {*rows})]
    return rows, unpaired(alone, others, files.robot.name)
