"""Files of a tracked stream, written frame by frame: JSON lines, TUM, MCAP.

MCAP holds the messages `/tf` (foxglove.FrameTransform), `/camera` (foxglove.CameraCalibration),
`/image` (foxglove.CompressedImage) and `/answer` (the JSON row), as JSON with Foxglove's schemas.
"""

import base64
import json
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any, Self

import numpy as np

from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.localization.tracking import TrackedFrame
from evercal.reports.answers import Answer, answer_row
from evercal.reports.overlay import encode_image

if TYPE_CHECKING:
    from numpy.typing import NDArray

ENDINGS = (".jsonl", ".tum", ".txt", ".mcap")


def track_row(frame: TrackedFrame, name: str, unit_known: bool = True) -> dict[str, object]:
    """Return a frame as JSON values: the row of `evercal localize --json`, state and time."""
    from evercal.geometry import pose_to_dict

    answer = Answer(Path(name), frame.estimate, frame.estimate.milliseconds, unit_known)
    return {
        "frame": frame.number,
        "stamp_s": frame.stamp_s,
        "state": frame.state,
        **answer_row(answer),
        "omitted": list(frame.estimate.omitted),
        "smoothed": pose_to_dict(frame.smoothed),
        "jumped": frame.jumped,
    }


class TrackFile(AbstractContextManager["TrackFile"]):
    """A file that grows by a frame at a time; its ending decides the format.

    Args:
        path: The file.

    Raises:
        InputError: Another ending, or the extra `streams` is not installed.
    """

    def __init__(self, path: Path):
        writers: dict[str, Callable[[Path], Any]] = {
            ".jsonl": _JsonLines,
            ".tum": _Tum,
            ".txt": _Tum,
            ".mcap": _Mcap,
        }
        if path.suffix.lower() not in writers:
            raise InputError(f"{path}: give a file name that ends with {', '.join(ENDINGS)}")
        self._writer = writers[path.suffix.lower()](path)

    def write(
        self, frame: TrackedFrame, row: dict[str, object], image: "NDArray[np.uint8]"
    ) -> None:
        """Append a frame; `row` is that of `track_row`."""
        self._writer.write(frame, row, image)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._writer.close()


class _JsonLines:
    """One JSON object a line."""

    def __init__(self, path: Path):
        self._file: IO[str] = path.open("w", encoding="utf-8")

    def write(self, _: TrackedFrame, row: dict[str, object], __: object) -> None:
        self._file.write(json.dumps(row) + "\n")
        self._file.flush()

    def close(self) -> None:
        self._file.close()


class _Tum:
    """`timestamp tx ty tz qx qy qz qw` a line; frames without a pose are missing."""

    def __init__(self, path: Path):
        self._file: IO[str] = path.open("w", encoding="utf-8")
        self._file.write("# timestamp tx ty tz qx qy qz qw: base_from_camera, metres\n")

    def write(self, frame: TrackedFrame, _: object, __: object) -> None:
        pose = frame.smoothed or frame.estimate.base_from_camera
        if pose is None or frame.state == "lost":
            return
        w, x, y, z = pose.rotation_wxyz
        values = (frame.stamp_s, *pose.translation_m, x, y, z, w)
        self._file.write(" ".join(f"{value:.9f}" for value in values) + "\n")
        self._file.flush()

    def close(self) -> None:
        self._file.close()


_TIME = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
_XYZ = {"type": "object", "properties": {axis: {"type": "number"} for axis in "xyz"}}
_XYZW = {"type": "object", "properties": {axis: {"type": "number"} for axis in "xyzw"}}
_TEXT, _NUMBERS = {"type": "string"}, {"type": "array", "items": {"type": "number"}}
_SCHEMAS: dict[str, tuple[str, dict[str, object]]] = {
    "/tf": (
        "foxglove.FrameTransform",
        {
            "timestamp": _TIME,
            "parent_frame_id": _TEXT,
            "child_frame_id": _TEXT,
            "translation": _XYZ,
            "rotation": _XYZW,
        },
    ),
    "/camera": (
        "foxglove.CameraCalibration",
        {
            "timestamp": _TIME,
            "frame_id": _TEXT,
            "width": {"type": "integer"},
            "height": {"type": "integer"},
            "distortion_model": _TEXT,
            **dict.fromkeys("DKRP", _NUMBERS),
        },
    ),
    "/image": (
        "foxglove.CompressedImage",
        {
            "timestamp": _TIME,
            "frame_id": _TEXT,
            "data": {"type": "string", "contentEncoding": "base64"},
            "format": _TEXT,
        },
    ),
    "/answer": ("evercal.Answer", {}),
}


class _Mcap:
    """Messages of Foxglove's schemas, JSON encoded."""

    def __init__(self, path: Path):
        try:
            from mcap.writer import Writer
        except ImportError:
            raise InputError(
                f"{path}: MCAP takes the extra: pip install 'evercal[streams]'"
            ) from None
        self._file: IO[bytes] = path.open("wb")
        self._writer = Writer(self._file)
        self._writer.start(profile="", library="evercal")
        self._channels = {}
        for topic, (name, properties) in _SCHEMAS.items():
            schema = json.dumps({"type": "object", "properties": properties}).encode()
            number = self._writer.register_schema(name, "jsonschema", schema)
            self._channels[topic] = self._writer.register_channel(topic, "json", number)

    def write(
        self, frame: TrackedFrame, row: dict[str, object], image: "NDArray[np.uint8]"
    ) -> None:
        # In two parts: a product of all seconds would lose the last hundred nanoseconds.
        nanoseconds = int(frame.stamp_s) * 10**9 + round((frame.stamp_s % 1) * 1e9)
        stamp = dict(zip(("sec", "nsec"), divmod(nanoseconds, 10**9), strict=True))
        camera, pose = frame.estimate.camera, frame.smoothed or frame.estimate.base_from_camera
        messages: dict[str, dict[str, object]] = {"/answer": row}
        if pose is not None and frame.state != "lost":
            w, x, y, z = (float(v) for v in pose.rotation_wxyz)
            position = dict(zip("xyz", map(float, pose.translation_m), strict=True))
            messages["/tf"] = {
                "timestamp": stamp,
                "parent_frame_id": "base",
                "child_frame_id": "camera",
                "translation": position,
                "rotation": {"x": x, "y": y, "z": z, "w": w},
            }
        if camera is not None:
            messages["/camera"] = {"timestamp": stamp, "frame_id": "camera", **_calibration(camera)}
        data = base64.b64encode(encode_image(image, "jpg")).decode()
        picture = {"timestamp": stamp, "frame_id": "camera", "data": data, "format": "jpeg"}
        messages["/image"] = picture
        for topic, message in messages.items():
            self._writer.add_message(
                self._channels[topic], nanoseconds, json.dumps(message).encode(), nanoseconds
            )

    def close(self) -> None:
        self._writer.finish()
        self._file.close()


def _calibration(camera: Camera) -> dict[str, object]:
    matrix = camera.matrix()
    return {
        "width": camera.width,
        "height": camera.height,
        "distortion_model": "rational_polynomial" if len(camera.distortion) > 5 else "plumb_bob",
        "D": list(camera.distortion) or [0.0] * 5,
        "K": matrix.ravel().tolist(),
        "R": np.eye(3).ravel().tolist(),
        "P": np.column_stack([matrix, np.zeros(3)]).ravel().tolist(),
    }
