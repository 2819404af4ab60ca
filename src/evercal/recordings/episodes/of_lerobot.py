"""Episodes of a LeRobot data set whose features state camera poses, file by file.

A feature such as `camera_extrinsics.exterior_1_left` states the pose of the camera
`observation.images.exterior_1_left`. Cameras on the arm are left out.
"""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from evercal.recordings.cameras.camera_file import read_camera_of_size
from evercal.recordings.episodes.episode import (
    Episode,
    frames_of,
    slow_rows,
    values_of_joints,
)
from evercal.recordings.formats import lerobot
from evercal.recordings.formats.lerobot_poses import STATE, Info, names_of
from evercal.recordings.images import files_in
from evercal.recordings.poses.row_files import number_array
from evercal.recordings.read_options import ReadOptions
from evercal.robot.robot_model import RobotModel
from evercal.storage.text_files import library_errors, named_errors
from evercal.typing import Array

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
        for file, number, rows, columns in _tables(
            root, [*filter(None, places.values())]
        ):
            stated = {}
            for place in filter(None, places.values()):
                stated[place] = tuple(columns[place][0].tolist())
            names, values = values_of_joints(
                model, names_of(info, STATE), columns[STATE], options.pose_convention
            )
            chosen = slow_rows(values, images)
            name = f"episode_{number:06d}"
            for key, place in places.items():
                taken = [
                    lerobot.Row(number, i, columns["timestamp"][i, 0], file, rows[i])
                    for i in chosen
                ]
                stored = lerobot.images_of(root, info, key, taken)
                frames = frames_of(stored, values[chosen], cameras[key])
                yield Episode(name, place or key, frames, names, stated)

    return total * len(places), each()


def _tables(
    root: Path, features: list[str]
) -> Iterator[tuple[Path, int, list[int], dict[str, Array]]]:
    """File and number of each episode, its rows in the file and its columns (n, k)."""
    names = ["episode_index", "timestamp", STATE, *features]
    for file in files_in(root / "data", (".parquet",), "*/*"):
        columns = {}
        for name, cells in zip(names, lerobot.columns(file, names), strict=True):
            with named_errors(file, name):
                columns[name] = number_array(cells, name).reshape(len(cells), -1)
        index = columns["episode_index"][:, 0]
        for number in np.unique(index):
            rows = np.nonzero(index == number)[0]
            yield (
                file,
                int(number),
                rows.tolist(),
                {name: values[rows] for name, values in columns.items()},
            )


def stated_features(root: Path, info: Info, wanted: str | None) -> dict[str, str]:
    """The feature that states the pose of each fixed camera; empty if there is none."""
    found = {}
    for key in lerobot.picture_keys(info):
        name = re.escape(key.rpartition(".")[2])
        part = re.compile(rf"(^|[._/]){name}($|[._/])")
        for feature in info["features"]:
            if "extrinsic" in feature and part.search(feature):
                found[key] = feature
    fixed = {key: found[key] for key in found if not _ON_THE_ARM.search(key)}
    if wanted is None and fixed:
        return fixed
    key = lerobot.camera_key(root, info, wanted)
    return {key: found.get(key, "")}
