"""Files of a tracked stream, written frame by frame: JSON lines or TUM."""

import json
from contextlib import AbstractContextManager
from pathlib import Path

from evercal.errors import InputError
from evercal.geometry import pose_to_dict
from evercal.localization.tracking import TrackedFrame
from evercal.reports.answers import Answer, answer_row
from evercal.storage.atomic import naming_file
from evercal.typing import JsonObject

ENDINGS = (".jsonl", ".tum", ".txt")
"""Endings of the names of files of poses."""
_TUM_HEADER = (
    "# timestamp tx ty tz qx qy qz qw: base_from_camera, in the unit of the map\n"
)


def track_row(frame: TrackedFrame, name: str, unit_known: bool = True) -> JsonObject:
    """Return a frame as JSON values: the row of `evercal localize --json`, state and time."""
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
    """A file that grows by a frame at a time.

    `.jsonl` holds one JSON object a line; `.tum` and `.txt` hold `timestamp tx ty tz qx qy qz qw`
    of the frames with a pose.
    """

    def __init__(self, path: Path):
        if path.suffix.lower() not in ENDINGS:
            raise InputError(
                f"{path}: give a file name that ends with {', '.join(ENDINGS)}"
            )
        self._tum = path.suffix.lower() != ".jsonl"
        self._path = path
        self._file = path.open("w", encoding="utf-8")
        if self._tum:
            self._file.write(_TUM_HEADER)

    def write(self, frame: TrackedFrame, row: JsonObject) -> None:
        """Append a frame; `row` is that of `track_row`."""
        line = json.dumps(row) + "\n"
        if self._tum:
            line = _tum_line(frame)
        with naming_file(self._path):
            self._file.write(line)
            self._file.flush()

    def __exit__(self, *_: object) -> None:
        with naming_file(self._path):
            self._file.close()


def _tum_line(frame: TrackedFrame) -> str:
    pose = frame.smoothed or frame.estimate.base_from_camera
    if not pose or frame.state == "lost":
        return ""
    w, x, y, z = pose.rotation_wxyz
    values = (frame.stamp_s, *pose.translation_m, x, y, z, w)
    return " ".join(f"{value:.9f}" for value in values) + "\n"
