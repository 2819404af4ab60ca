"""`Client`: a map that another process or machine serves, with the methods of `Map`."""

import io
import json
import os
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar
from urllib.parse import quote

from evercal.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from evercal.calibration.calibration import Calibration, Mount
    from evercal.calibration.drift import Shift
    from evercal.calibration.from_images import ImageSource
    from evercal.geometry import SE3, Camera
    from evercal.learning.scene import LearnReport
    from evercal.localization.estimate import PoseEstimate

Record = TypeVar("Record")
Part = tuple[str, bytes]
"""File name and content."""
_POLL_S = 0.5


class Client:
    """A map that `evercal serve` serves.

    Images may be arrays, which are sent as PNG, or files, which are sent as they are.

    Args:
        url: Address of the service, such as `http://127.0.0.1:8000`.
        token: The token that the service was started with, if any.
        timeout: Time to wait for an answer, seconds.

    Raises:
        InputError: The package that sends requests is missing (extra `serve`).
    """

    def __init__(self, url: str, token: str | None = None, timeout: float = 60.0):
        try:
            import urllib3
        except ImportError:
            raise InputError("a client needs urllib3; run: pip install 'evercal[serve]'") from None
        headers = {} if token is None else {"Authorization": f"Bearer {token}"}
        self._url = url.rstrip("/")
        # An answer that was lost is not asked for again: a scene would be learned twice.
        retries = urllib3.Retry(
            connect=2, read=0, redirect=0, status=0, other=0, backoff_factor=0.1
        )
        self._pool = urllib3.PoolManager(
            8, headers, timeout=urllib3.Timeout(timeout), retries=retries
        )

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of the scenes, in order of learning."""
        return tuple(self._ask("GET", "/scenes")["scenes"])

    def localize(
        self, image: "np.ndarray | str | os.PathLike[str]", camera: "Camera | None" = None
    ) -> "PoseEstimate":
        """Estimate the camera pose of one image, see `Map.localize`.

        Inlier pixels, the estimated intrinsics and the terms of the covariance are not sent.

        Raises:
            InputError: An image or camera that the service refuses, or no service answers.
        """
        parts = [("image", _image_part(image, "image.png")), *_camera_part(camera)]
        return _estimate(self._ask("POST", "/localize", parts))

    def calibrate(
        self,
        images: "ImageSource",
        *,
        robot_poses: "str | os.PathLike[str] | SE3 | None" = None,
        camera: "Camera | None" = None,
        mount: "Mount | None" = None,
    ) -> "Calibration":
        """Calibrate a camera from its images, see `Map.calibrate`.

        Raises:
            InputError: As `Map.calibrate`, or no service answers.
        """
        from evercal.calibration.calibration import Calibration

        parts: list[tuple[str, Part | str]] = [*_image_parts(images), *_camera_part(camera)]
        if robot_poses is not None:
            parts.append(("robot_poses", _poses_part(robot_poses)))
        if mount is not None:
            parts.append(("mount", mount))
        return Calibration.from_dict(self._ask("POST", "/calibrations", parts))

    def check(
        self,
        images: "ImageSource",
        calibration: "Calibration",
        *,
        camera: "Camera | None" = None,
    ) -> "Shift":
        """Test whether a fixed camera has moved, see `Map.check`.

        `Shift.images` holds only the images that were left out.

        Raises:
            InputError: As `Map.check`, or no service answers.
        """
        from evercal.calibration.calibration import ImageUse
        from evercal.calibration.drift import Shift
        from evercal.geometry import SE3

        reference = json.dumps(calibration.to_dict()).encode()
        parts = [*_image_parts(images), *_camera_part(camera)]
        record = self._ask(
            "POST", "/check", [*parts, ("calibration", ("calibration.json", reference))]
        )
        record.pop("images")
        left_out = tuple(ImageUse(**use) for use in record.pop("left_out"))
        pose = SE3.from_matrix(record.pop("reference_from_now"))
        return Shift(reference_from_now=pose, images=left_out, **record)

    def learn(
        self,
        recording: str | os.PathLike[str],
        *,
        name: str | None = None,
        memory: str | int | None = None,
        on_server: bool = False,
        on_progress: Callable[[str, int, int], object] = lambda *_: None,
    ) -> "LearnReport":
        """Learn a scene on the service and wait for it, see `Map.learn`.

        Args:
            recording: Folder or bag file; it is sent as an archive.
            name: Of the scene. Default: the recording's name.
            memory: Keyframes to keep, as for `Map.learn`.
            on_server: The recording is a path below the service's own folder of recordings.
            on_progress: Called with the current step, how much of it is done, and its total.

        Raises:
            InputError: A recording that cannot be used, a name that is taken, or no service
                answers.
        """
        from evercal.learning.scene import LearnReport

        given = {"name": name, "memory": None if memory is None else str(memory)}
        fields = {key: value for key, value in given.items() if value is not None}
        if on_server:
            body = json.dumps({"path": str(recording), **fields}).encode()
            job = self._send("POST", "/scenes", body, "application/json")
        else:
            with tempfile.TemporaryFile() as archive:
                _archive(Path(recording), archive)
                query = "&".join(f"{key}={quote(value)}" for key, value in fields.items())
                job = self._send("POST", f"/scenes?{query}", archive, "application/zip")
        while job["status"] not in ("done", "failed"):
            time.sleep(_POLL_S)
            job = self._ask("GET", f"/jobs/{job['id']}")
            if job["step"]:
                on_progress(job["step"], job["done"], job["total"])
        if job["status"] == "failed":
            raise InputError(f"{recording}: {job['error']}")
        return _report(LearnReport, job["report"])

    def remove(self, *names: str) -> None:
        """Remove scenes, one after the other.

        Raises:
            InputError: No such scene, another process writes into the map, or no service answers.
        """
        for name in names:
            self._ask("DELETE", f"/scenes/{quote(name, safe='')}")

    def _ask(
        self, method: str, path: str, parts: "Sequence[tuple[str, Part | str]] | None" = None
    ) -> Any:
        """The JSON value that the service answers a request with."""
        import urllib3

        if parts is None:
            return self._send(method, path)
        body, kind = urllib3.encode_multipart_formdata(list(parts))
        return self._send(method, path, body, kind)

    def _send(self, method: str, path: str, body: Any = None, kind: str | None = None) -> Any:
        import urllib3

        headers = {**self._pool.headers, **({} if kind is None else {"Content-Type": kind})}
        try:
            answer = self._pool.request(method, self._url + path, body=body, headers=headers)
        except urllib3.exceptions.HTTPError as error:
            raise InputError(f"{self._url}: no answer ({_reason(error)})") from None
        if answer.status == 204:
            return None
        try:
            content = json.loads(answer.data)
        except ValueError:
            content = None
        if answer.status >= 400 or content is None:
            error = content.get("error") if isinstance(content, dict) else None
            raise InputError(error or f"{self._url}: status {answer.status}; is it evercal serve?")
        return content


def _reason(error: Exception) -> str:
    reason = getattr(error, "reason", None) or error
    return " ".join(str(reason).split())[:200]


def _image_part(image: "np.ndarray | str | os.PathLike[str]", name: str) -> Part:
    if isinstance(image, str | os.PathLike):
        path = Path(image)
        try:
            return path.name, path.read_bytes()
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    import cv2

    from evercal.recordings.images import as_rgb

    _, data = cv2.imencode(".png", as_rgb(image)[:, :, ::-1])
    return name, data.tobytes()


def _image_parts(source: "ImageSource") -> list[tuple[str, Part | str]]:
    import numpy as np

    from evercal.recordings.image_files import image_files

    single = isinstance(source, str | os.PathLike) or (
        isinstance(source, np.ndarray) and source.ndim < 4
    )
    items: list[Any] = [source] if single else [*source]  # pyright: ignore[reportGeneralTypeIssues]
    if not items or isinstance(items[0], str | os.PathLike):
        items = [*image_files(items)]
    return [("images", _image_part(item, f"image {i}")) for i, item in enumerate(items)]


def _camera_part(camera: "Camera | None") -> list[tuple[str, Part | str]]:
    if camera is None:
        return []
    return [("camera", ("camera.json", json.dumps(camera.to_dict()).encode()))]


def _poses_part(poses: "str | os.PathLike[str] | SE3") -> Part:
    if isinstance(poses, str | os.PathLike):
        return _image_part(poses, "")
    rows = ["x,y,z,qw,qx,qy,qz"]
    for pose in poses:
        rows.append(",".join(repr(float(v)) for v in (*pose.translation_m, *pose.rotation_wxyz)))
    return "poses.csv", "\n".join(rows).encode()


def _archive(recording: Path, file: Any) -> None:
    """Write a recording into an open file as a zip archive, ready to be sent."""
    import zipfile

    if not recording.exists():
        raise InputError(f"{recording}: no such folder; give the folder of a recorded scene")
    with zipfile.ZipFile(file, "w", strict_timestamps=False) as archive:
        if recording.is_file():
            archive.write(recording, recording.name)
        else:
            for path in sorted(path for path in recording.rglob("*") if path.is_file()):
                archive.write(path, Path(recording.resolve().name) / path.relative_to(recording))
    file.seek(0, io.SEEK_SET)


def _estimate(row: Mapping[str, Any]) -> "PoseEstimate":
    import numpy as np

    from evercal.localization.estimate import PoseEstimate

    covariance = row["covariance"]
    return PoseEstimate(
        status=row["status"],
        reason=row["reason"],
        scene=row["scene"],
        base_from_camera=_pose(row["base_from_camera"]),
        covariance=None if covariance is None else np.array(covariance),
        inliers=row["inliers"],
        inlier_ratio=row["inlier_ratio"],
        support=row["support"],
        milliseconds=row["ms"],
        alternatives=tuple(p for p in map(_pose, row["alternatives"]) if p is not None),
    )


def _pose(values: Mapping[str, Any] | None) -> "SE3 | None":
    from evercal.geometry import SE3

    return None if values is None else SE3(values["quaternion_wxyz"], values["translation_m"])


def _report(kind: "type[LearnReport]", record: dict[str, Any]) -> "LearnReport":
    from evercal.calibration.eye_in_hand import HandEyeReport
    from evercal.mapping.build import Adjusted

    nested = {"adjusted": Adjusted, "hand_eye": HandEyeReport}
    values: dict[str, Any] = {
        key: nested[key](**{k: _tuples(v) for k, v in value.items()})
        if key in nested and value is not None
        else value
        for key, value in record.items()
    }
    return kind(**values)


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value
