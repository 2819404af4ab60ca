"""Poses of a board in images, with their corners and intrinsics, and the file that holds them.

    {"format": "evercal-board-poses", "version": 1, "board": {"kind": "chessboard", ...},
     "camera": {...}, "camera_from": "board", "corner_sigma_px": x,
     "images": [{"name": "image-1.png", "reason": "", "rms_px": x,
                 "camera_from_board": {"translation_m": [3], "quaternion_wxyz": [4]},
                 "covariance": [6][6], "points_m": [k][3], "pixels": [k][2]}, ...]}

An image without a board has a reason, and null in place of the rest. Covariances are of
(translation in the camera's axes, metres; rotation about the board's axes, radians).
"""

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from evercal.calibration.boards.corners import BoardPose, BoardView, board_pose, pixel_sigma
from evercal.calibration.boards.detection import Board
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.storage import write_json

Array = NDArray[np.floating]

FORMAT, VERSION = "evercal-board-poses", 1


@dataclass(frozen=True, eq=False)
class BoardImage:
    """One image and the board in it."""

    name: str
    """File name of the image."""
    view: BoardView | None
    """Corners; None without a board."""
    camera_from_board: SE3 | None
    """Single; None without a board."""
    covariance: Array | None
    """(6, 6); None without a board."""
    rms_px: float | None = None
    """Root mean square distance of the corners from where the pose puts them."""
    reason: str = ""
    """Why there is no pose; empty if there is one."""


@dataclass(frozen=True, eq=False)
class BoardPoses:
    """All images of one camera."""

    board: Board
    """What they show."""
    camera: Camera
    """Intrinsics of all of them."""
    images: tuple[BoardImage, ...]
    """In the order that they were given in."""
    corner_sigma_px: float
    """Standard deviation of a corner coordinate."""
    camera_from: str = "file"
    """`file`, or `board` if the intrinsics were found from these images."""

    @property
    def found(self) -> tuple[BoardImage, ...]:
        """The images that show the board."""
        return tuple(image for image in self.images if image.camera_from_board is not None)

    def to_dict(self) -> dict[str, Any]:
        """JSON values, see the top of this file."""
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
        """The reverse of `to_dict`.

        Raises:
            ValueError: Something else, of another version, or broken.
        """
        if not isinstance(data, Mapping) or data.get("format") != FORMAT:
            raise ValueError(f"no board poses: 'format' is not {FORMAT!r}")
        if data.get("version") != VERSION:
            raise ValueError(f"version {data.get('version')!r}; this evercal reads {VERSION}")
        try:
            return cls(
                Board.from_dict(data["board"]),
                Camera.from_dict(data["camera"]),
                tuple(_image_from_dict(image) for image in data["images"]),
                float(data["corner_sigma_px"]),
                str(data.get("camera_from", "file")),
            )
        except KeyError as error:
            raise ValueError(f"{error} is missing") from None
        except TypeError as error:
            raise ValueError(f"an entry has the wrong kind of value ({error})") from None

    def write(self, path: str | os.PathLike[str]) -> None:
        """Creates or replaces the file, whole or not at all."""
        write_json(path, self.to_dict())


def read_board_poses(path: str | os.PathLike[str]) -> BoardPoses:
    """Reads a file that `evercal detect` wrote.

    Raises:
        InputError: Missing, no JSON, or no board poses.
    """
    path = Path(path)
    try:
        return BoardPoses.from_dict(json.loads(path.read_text(encoding="utf-8")))
    except FileNotFoundError:
        raise InputError(f"{path}: file of camera poses is missing; check the path") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError as error:
        raise InputError(f"{path}: {error}; give the JSON that evercal detect wrote") from None


def board_poses(
    board: Board,
    camera: Camera,
    views: Mapping[str, BoardView | str],
    camera_from: str = "file",
) -> BoardPoses:
    """Fits the pose of the board in every image.

    Args:
        board: what the images show.
        camera: intrinsics of all.
        views: by name of the image its corners, or why there are none.
        camera_from: `file` or `board`.
    """
    fitted: dict[str, BoardPose | str] = {
        name: view if isinstance(view, str) else _fitted(view, camera)
        for name, view in views.items()
    }
    poses = [pose for pose in fitted.values() if isinstance(pose, BoardPose)]
    sigma = pixel_sigma(poses) if poses else 0.0
    images = []
    for name, pose in fitted.items():
        view = views[name]
        if isinstance(pose, str) or isinstance(view, str):
            images.append(BoardImage(name, None, None, None, None, str(pose)))
            continue
        covariance = sigma**2 * pose.unit_covariance
        images.append(BoardImage(name, view, pose.camera_from_board, covariance, pose.rms_px))
    return BoardPoses(board, camera, tuple(images), sigma, camera_from)


def _fitted(view: BoardView, camera: Camera) -> BoardPose | str:
    try:
        return board_pose(view, camera)
    except ValueError:
        return "the corners found fit no pose of the board"


def _image_to_dict(image: BoardImage) -> dict[str, Any]:
    pose, view = image.camera_from_board, image.view
    return {
        "name": image.name,
        "reason": image.reason,
        "rms_px": image.rms_px,
        "camera_from_board": None
        if pose is None
        else {
            "translation_m": pose.translation_m.tolist(),
            "quaternion_wxyz": pose.rotation_wxyz.tolist(),
        },
        "covariance": None if image.covariance is None else image.covariance.tolist(),
        "points_m": None if view is None else view.points_m.tolist(),
        "pixels": None if view is None else view.pixels.tolist(),
    }


def _image_from_dict(data: Mapping[str, Any]) -> BoardImage:
    name, pose = str(data["name"]), data["camera_from_board"]
    if pose is None:
        return BoardImage(name, None, None, None, None, str(data.get("reason", "no board")))
    covariance = np.asarray(data["covariance"], dtype=np.float64)
    if covariance.shape != (6, 6) or not np.isfinite(covariance).all():
        raise ValueError(f"'covariance' of {name} is 6x6 and finite, got {covariance.shape}")
    return BoardImage(
        name,
        BoardView(data["points_m"], data["pixels"]),
        SE3(pose["quaternion_wxyz"], pose["translation_m"]),
        covariance,
        float(data["rms_px"]),
    )
