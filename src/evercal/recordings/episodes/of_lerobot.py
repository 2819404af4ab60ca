"""Episodes of a LeRobot data set whose features state camera poses, file by file.

A feature such as `camera_extrinsics.exterior_1_left` states the pose of the camera
`observation.images.exterior_1_left`. Cameras on the arm are left out.
"""

import re
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

from evercal.recordings.cameras.camera_file import read_camera_of_size
from evercal.recordings.episodes.episode import (
    Episode,
    frames_of,
    slow_rows,
    values_of_joints,
)
from evercal.recordings.formats import lerobot
from evercal.recordings.formats.lerobot_poses import STATE, names_of
from evercal.recordings.poses.row_files import number_array
from evercal.recordings.read_options import ReadOptions
from evercal.robot.robot_model import RobotModel
from evercal.storage.text_files import library_errors, named_errors
from evercal.typing import Record

_ON_THE_ARM = re.compile("wrist|hand|gripper")
"""Words in the names of cameras that move."""


def episodes(
    root: Path, model: RobotModel, camera: Path, options: ReadOptions, images: int
) -> tuple[int, Iterator[Episode]]:
    """See `episodes_in`."""
    with library_errors(f"{root / lerobot.INFO}: does not describe the dataset"):
        info = lerobot.dataset_info(root)
        total = int(info["total_episodes"])
        places = stated_features(root, info, options.image_topic)
        cameras = {}
        for key in places:
            size = lerobot.image_size_of(info, key)
            cameras[key] = read_camera_of_size(camera, size, key)

    def each() -> Iterator[Episode]:
        for file in lerobot.data_files(root):
            rows, values = lerobot.rows_in(file, STATE)
            names, values = values_of_joints(
                model, names_of(info, STATE), values, options.pose_convention
            )
            poses = {}
            for place in filter(None, places.values()):
                (cells,) = lerobot.columns(file, [place])
                with named_errors(file, place):
                    poses[place] = number_array(cells, place).reshape(len(cells), -1)
            for number, own in groupby(enumerate(rows), lambda row: row[1].episode):
                of_episode = [i for i, _ in own]
                first = of_episode[0]
                stated = {place: tuple(poses[place][first].tolist()) for place in poses}
                slow = slow_rows(values[of_episode], images)
                chosen = [of_episode[i] for i in slow]
                for key, place in places.items():
                    shown = [rows[i] for i in chosen]
                    stored = lerobot.images_of(root, info, key, shown)
                    frames = frames_of(stored, values[chosen], cameras[key])
                    name = f"episode_{number:06d}"
                    yield Episode(name, place or key, frames, names, stated)

    return total * len(places), each()


def stated_features(root: Path, info: Record, wanted: str | None) -> dict[str, str]:
    """The feature that states the pose of each fixed camera; empty if there is none."""
    found = {}
    for key in lerobot.picture_keys(info):
        name = re.escape(key.rpartition(".")[2])
        part = rf"(^|[._/]){name}($|[._/])"
        for feature in info["features"]:
            if "extrinsic" in feature and re.search(part, feature):
                found[key] = feature
    fixed = {key: found[key] for key in found if not _ON_THE_ARM.search(key)}
    if wanted is None and fixed:
        return fixed
    key = lerobot.camera_key(root, info, wanted)
    return {key: found.get(key, "")}
