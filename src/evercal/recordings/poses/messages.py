"""Messages of ROS that hold several poses: tf, and detections of tags."""

import re
from collections.abc import Iterator, Mapping
from typing import Any

from evercal.recordings.poses.conventions import ConventionError, Given
from evercal.storage.text_files import few, natural_key
from evercal.typing import JsonObject, Record

DETECTIONS = {"detections", "markers"}
"""Keys of detections: of apriltag_ros, and of aruco_ros, aruco_opencv and ar_track_alvar."""
_NUMBERS = re.compile("(marker_|fiducial_|tag_)?ids?")
"""Keys of the numbers of tags."""
_TAG = re.compile("(?i)tag|marker|aruco|fiducial")
"""Words in the frame of a tag."""


def entries_of_messages(entries: list[Any], given: Given) -> list[Any]:
    """The entries of a list in each message, with the header of the message.

    Of several tags, those with the stated number. ValueError: it is not clear which.
    """
    keys = {key for entry in entries for key in entry if _is_list(entry[key])}
    if len(keys) != 1:
        return entries
    (key,) = keys
    wanted = given.tag if given else ""
    rows: list[Any] = []
    found: set[str] = set()
    for entry in entries:
        of_message: set[str] = set()
        for row, tag in _rows(entry, key):
            if wanted and not re.search(rf"(?<!\d){wanted}$", tag):
                continue
            if tag and tag in of_message:
                raise ValueError(f"tag {tag} is twice in one message; keep one")
            of_message.add(tag)
            rows.append(row)
        found |= of_message
    if not rows:
        raise ValueError("no message holds a pose of this tag")
    if len(found) > 1:
        tags = sorted(found, key=natural_key)
        problem = f"it holds poses of the tags {few(tags)}"
        raise ConventionError(problem, "of one, such as xyzw:tag4 for tag 4")
    return rows


def _rows(message: Record, key: str) -> Iterator[tuple[JsonObject, str]]:
    """Each entry of a list in a message, and its tag; empty if it is of none."""
    for i, entry in enumerate(message.get(key) or ()):
        row = {**message, **entry}
        del row[key]
        tag = ""
        for name, value in row.items():
            if _NUMBERS.fullmatch(name):
                if isinstance(value, list):
                    value = value[i] if name in message else value[0]
                tag = str(value)
            elif name == "child_frame_id" and _TAG.search(str(value)):
                tag = str(value)
        yield row, tag


def _is_list(value: object) -> bool:
    """Whether a value is a list of objects."""
    return isinstance(value, list) and bool(value) and isinstance(value[0], Mapping)
