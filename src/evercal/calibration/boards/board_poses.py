"""Board poses of images with corners and intrinsics, and their file.

    {"format": "evercal-board-poses", "version": 1, "board": {"kind": "chessboard", ...},
     "camera": {...}, "camera_from": "board", "corner_sigma_px": x,
     "images": [{"name": "image-1.png", "reason": "", "rms_px": x,
                 "camera_from_board": {"translation_m": [3], "quaternion_wxyz": [4]},
                 "covariance": [6][6], "points_m": [k][3], "pixels": [k][2],
                 "left_out": [m][2]}, ...]}

Image names are paths relative to the file. An image without a board has a reason, and null for all
other fields. Covariances are those of `BoardPose`. Pixels `left_out` are corners that leave their
neighbours.
"""

from collections.abc import Mapping
from contextlib import suppress
from typing import Self

import numpy as np

from evercal.calibration.boards.board import Board
from evercal.calibration.boards.corners import (
    BoardPose,
    BoardView,
    Detection,
    board_pose,
    strays,
)
from evercal.calibration.boards.row_shift import CornerNoise
from evercal.classes import frozen_arrays
from evercal.geometry import SE3, Camera, pose_to_dict
from evercal.storage import write_json
from evercal.storage.records import of_format, read_record
from evercal.typing import Array, JsonObject, Pair, PathLike, Record

FORMAT = "evercal-board-poses"
VERSION = 1


@frozen_arrays
class BoardImage:
    """One image; without a board, only `name` and `reason` are set."""

    name: str
    """Path relative to the file of board poses, or a bare file name."""
    view: BoardView | None = None
    camera_from_board: SE3 | None = None
    covariance: Array | None = None
    rms_px: float | None = None
    """Root mean square reprojection error of the corners."""
    reason: str = ""
    """Reason for a missing pose, otherwise empty."""
    left_out: tuple[Pair, ...] = ()
    """Pixels x, y of corners that leave their neighbours by many sigma."""


@frozen_arrays
class BoardPoses:
    """Board poses of all images of one camera."""

    board: Board
    camera: Camera
    """Intrinsics of all images."""
    images: tuple[BoardImage, ...]
    corner_sigma_px: float
    """Standard deviation of a corner coordinate."""
    camera_from: str = "file"
    """Source of the intrinsics: `file`, or `board` if they were estimated from these images."""

    @property
    def detected(self) -> tuple[BoardImage, ...]:
        """Images that show the board."""
        return tuple(image for image in self.images if image.camera_from_board)

    def to_dict(self) -> JsonObject:
        """Return the JSON values described at the top of this file."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "board": self.board.to_dict(),
            "camera": self.camera.to_dict(),
            "camera_from": self.camera_from,
            "corner_sigma_px": self.corner_sigma_px,
            "images": [_image_to_dict(image) for image in self.images],
        }

    @classmethod
    def from_dict(cls, data: object) -> Self:
        """Create board poses from the values of `to_dict`, or raise ValueError."""

        def read(values: Record) -> Self:
            return cls(
                board=Board.from_dict(values["board"]),
                camera=Camera.from_dict(values["camera"]),
                images=tuple(_image_from_dict(image) for image in values["images"]),
                corner_sigma_px=float(values["corner_sigma_px"]),
                camera_from=str(values.get("camera_from", "file")),
            )

        return of_format(data, FORMAT, VERSION, read)

    def write(self, path: PathLike) -> None:
        """Write the file atomically."""
        write_json(path, self.to_dict())


def read_board_poses(path: PathLike) -> BoardPoses:
    """Read a file written by `evercal detect`."""
    return read_record(path, "file of camera poses", BoardPoses.from_dict)


def board_poses(
    board: Board,
    camera: Camera,
    views: Mapping[str, Detection],
    camera_from: str = "file",
) -> BoardPoses:
    """Fit the pose of the board in every image; a view may be the reason for a missing board."""
    detected: dict[str, BoardView] = {}
    fits: dict[str, BoardPose] = {}
    for name, view in views.items():
        with suppress(ValueError):
            if isinstance(view, BoardView):
                fits[name] = board_pose(view, camera)
                detected[name] = view
    left_out = {}
    stray = strays(
        list(detected.values()),
        list(fits.values()),
        camera,
    )
    for name, mask in zip(fits, stray, strict=True):
        view = detected[name]
        left_out[name] = tuple((x, y) for x, y in view.pixels[mask].tolist())
        if mask.any():
            detected[name] = view[~mask]
            start = fits[name].camera_from_board
            fits[name] = board_pose(detected[name], camera, start)
    sigma = 0.0
    if fits:
        sigma = CornerNoise.plain(list(fits.values())).sigma_px
    images: list[BoardImage] = []
    for name, view in views.items():
        if name in fits:
            fit = fits[name]
            image = BoardImage(
                name,
                detected[name],
                fit.camera_from_board,
                sigma**2 * fit.unit_covariance,
                fit.rms_px,
                left_out=left_out[name],
            )
        else:
            misfit = "the detected corners fit no pose of the board"
            reason = view if isinstance(view, str) else misfit
            image = BoardImage(name, reason=reason)
        images.append(image)
    return BoardPoses(
        board,
        camera,
        tuple(images),
        sigma,
        camera_from,
    )


def _image_to_dict(image: BoardImage) -> JsonObject:
    record: JsonObject = {
        "name": image.name,
        "reason": image.reason,
        "rms_px": image.rms_px,
        "camera_from_board": pose_to_dict(image.camera_from_board),
        "covariance": None,
        "points_m": None,
        "pixels": None,
        "left_out": image.left_out,
    }
    if image.covariance is not None:
        record["covariance"] = image.covariance.tolist()
    if image.view:
        record["points_m"] = image.view.points_m.tolist()
        record["pixels"] = image.view.pixels.tolist()
    return record


def _image_from_dict(data: Record) -> BoardImage:
    name = str(data["name"])
    pose = data["camera_from_board"]
    if pose is None:
        return BoardImage(name, reason=str(data.get("reason", "no board")))
    covariance = np.asarray(data["covariance"], float)
    if covariance.shape != (6, 6) or not np.isfinite(covariance).all():
        raise ValueError(
            f"'covariance' of {name} must be finite and 6x6, got {covariance.shape}"
        )
    return BoardImage(
        name,
        BoardView(data["points_m"], data["pixels"]),
        SE3(pose["quaternion_wxyz"], pose["translation_m"]),
        covariance,
        float(data["rms_px"]),
        left_out=tuple((float(x), float(y)) for x, y in data.get("left_out", ())),
    )
