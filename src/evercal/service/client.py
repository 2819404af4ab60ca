"""`Client`: localize, calibrate and check with a map that another process or machine serves."""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from evercal.calibration.calibration import Calibration, ImageUse
from evercal.errors import InputError, missing_extra
from evercal.geometry import SE3, Camera
from evercal.localization.estimate import PoseEstimate
from evercal.recordings.images import as_rgb
from evercal.robot.mount import MountName
from evercal.typing import PathLike, Record, Strings

if TYPE_CHECKING:
    from evercal.calibration.drift import Shift
    from evercal.calibration.image_source import ImageSource

Part = tuple[str, bytes]
"""File name and content."""
Parts = list[tuple[str, Part | str]]
"""Parts of a request by name."""


class Client:
    """A map that `evercal serve` serves.

    Images may be arrays, which are sent as PNG, or files, which are sent as they are.

    Every method raises `InputError` with the line of the service, or if none answers.

    Args:
        url: Address of the service, such as `http://127.0.0.1:8000`.
        token: The token that the service was started with, if any.
        timeout: Time to wait for an answer, seconds.
    """

    def __init__(self, url: str, token: str | None = None, timeout: float = 60.0):
        try:
            import urllib3
        except ImportError:
            raise missing_extra("a client needs urllib3", "serve") from None
        headers = {} if token is None else {"Authorization": f"Bearer {token}"}
        self._url = url.rstrip("/")
        retries = urllib3.Retry(
            connect=2, read=0, redirect=0, status=0, other=0, backoff_factor=0.1
        )
        self._pool = urllib3.PoolManager(
            8, headers, timeout=urllib3.Timeout(timeout), retries=retries
        )

    @property
    def scenes(self) -> Strings:
        """Names of the scenes, in order of learning."""
        return tuple(self._ask("GET", "/scenes")["scenes"])

    def localize(
        self,
        image: np.ndarray | PathLike,
        camera: Camera | None = None,
        scenes: Strings = (),
    ) -> PoseEstimate:
        """Estimate the camera pose of one image, see `Map.localize`.

        Inlier pixels, the estimated intrinsics and the terms of the covariance are not sent.
        """
        parts: Parts = [
            ("image", _image_part(image, "image.png")),
            *_json_part("camera", camera),
            *_scene_parts(scenes),
        ]
        return _estimate(self._ask("POST", "/localize", parts))

    def calibrate(
        self,
        images: "ImageSource",
        *,
        robot_poses: PathLike | SE3 | None = None,
        camera: Camera | None = None,
        mount: MountName | None = None,
        scenes: Strings = (),
    ) -> Calibration:
        """Calibrate a camera from its images, see `Map.calibrate`."""
        parts = _image_parts(images, robot_poses, camera)
        if mount is not None:
            parts.append(("mount", mount))
        parts += _scene_parts(scenes)
        return Calibration.from_dict(self._ask("POST", "/calibrations", parts))

    def check(
        self,
        images: "ImageSource",
        calibration: Calibration,
        *,
        robot_poses: PathLike | SE3 | None = None,
        camera: Camera | None = None,
        scenes: Strings = (),
    ) -> "Shift":
        """Test whether a fixed camera has moved, see `Map.check`.

        `Shift.images` holds only the images that were left out.
        """
        from evercal.calibration.drift import Shift

        parts = _image_parts(images, robot_poses, camera)
        parts += _json_part("calibration", calibration)
        parts += _scene_parts(scenes)
        record = self._ask("POST", "/check", parts)
        record.pop("images")
        left_out = tuple(ImageUse(**use) for use in record.pop("left_out"))
        pose = SE3.from_matrix(record.pop("reference_from_now"))
        return Shift(reference_from_now=pose, images=left_out, **record)

    def _ask(self, method: str, path: str, parts: Parts | None = None) -> Any:
        """The JSON value that the service answers a request with."""
        import urllib3

        try:
            answer = self._pool.request(method, self._url + path, fields=parts)
        except urllib3.exceptions.HTTPError as error:
            reason = " ".join(str(getattr(error, "reason", None) or error).split())
            raise InputError(f"{self._url}: no answer ({reason[:200]})") from None
        try:
            content = json.loads(answer.data)
        except ValueError:
            content = None
        if answer.status < 400 and content is not None:
            return content
        message = f"{self._url}: status {answer.status}; is it evercal serve?"
        if isinstance(content, dict):
            message = content.get("error") or message
        raise InputError(message)


def _scene_parts(scenes: Strings) -> Parts:
    return [("scene", name) for name in scenes]


def _image_part(image: np.ndarray | PathLike, name: str) -> Part:
    if isinstance(image, str | os.PathLike):
        path = Path(image)
        try:
            return path.name, path.read_bytes()
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    _, data = cv2.imencode(".png", as_rgb(image)[:, :, ::-1])
    return name, data.tobytes()


def _image_parts(
    source: "ImageSource", robot_poses: PathLike | SE3 | None, camera: Camera | None
) -> Parts:
    """Images of one camera, with intrinsics and gripper poses if they are given."""
    from evercal.calibration.image_source import Images

    parts: Parts = []
    pictures: Sequence[tuple[str, Any]] = Images.of(source).images
    for name, picture in pictures:
        parts.append(("images", _image_part(picture, name)))
    parts += _json_part("camera", camera)
    if robot_poses is not None:
        parts.append(("robot_poses", _poses_part(robot_poses)))
    return parts


def _json_part(name: str, record: Camera | Calibration | None) -> Parts:
    if record is None:
        return []
    return [(name, (f"{name}.json", json.dumps(record.to_dict()).encode()))]


def _poses_part(poses: PathLike | SE3) -> Part:
    if isinstance(poses, str | os.PathLike):
        return _image_part(poses, "")
    lines = ["x,y,z,qw,qx,qy,qz"]
    for pose in poses:
        numbers = [*pose.translation_m.tolist(), *pose.rotation_wxyz.tolist()]
        lines.append(",".join(map(repr, numbers)))
    return "poses.csv", "\n".join(lines).encode()


def _estimate(row: Record) -> PoseEstimate:
    pose = row["base_from_camera"]
    covariance = row["covariance"]
    return PoseEstimate(
        status=row["status"],
        reason=row["reason"],
        scene=row["scene"],
        inliers=row["inliers"],
        inlier_ratio=row["inlier_ratio"],
        support=row["support"],
        parent_frame=row["parent_frame"],
        base_from_camera=pose and _pose(pose),
        covariance=covariance and np.array(covariance),
        milliseconds=row["ms"],
        alternatives=tuple(map(_pose, row["alternatives"])),
        alternatives_in=tuple(row["alternatives_in"]),
        base=row["base"],
    )


def _pose(values: Record) -> SE3:
    return SE3(values["quaternion_wxyz"], values["translation_m"])
