"""Messages of ROS that hold several poses: tf, and detections of tags."""

import re
from collections.abc import Mapping
from typing import Any

from evercal.recordings.poses.conventions import ConventionError, Given
from evercal.storage.text_files import few, natural_key

DETECTIONS = {"detections", "markers"}
"""Keys of detections: of apriltag_ros, and of aruco_ros, aruco_opencv and ar_track_alvar."""
_TAG = re.compile(
    r"(?is)(?:marker_|fiducial_|tag_)?ids?=.*|child_frame_id=.*(?:tag|marker|aruco|fiducial).*"
)
"""Keys with values that say which tag a pose is of."""


def entries_of_messages(entries: list[Any], given: Given) -> list[Any]:
    """The entries of the list in each message, with the header of the message.

    Of several tags, those with the stated number. ValueError: it is not clear which.
    """
    keys = set()
    for entry in entries:
        for key, value in entry.items():
            if isinstance(value, list) and value and isinstance(value[0], Mapping):
                keys.add(key)
    if len(keys) != 1:
        return entries
    (key,) = keys
    wanted = given.tag if given else ""
    rows = []
    found = set()
    for message in entries:
        of_message = set()
        for entry in message.get(key) or ():
            row = {**message, key: None, **entry}
            words = [f"{name}={value}" for name, value in row.items()]
            tag = next(filter(_TAG.fullmatch, words), "").partition("=")[2]
            if wanted and not re.search(rf"(?<!\d){wanted}\D*$", tag):
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
