"""Episodes in the layout of DROID's raw data (Khazatsky et al., RSS 2024).

    LAB/success/DATE/TIME/metadata_UUID.json            ext1_cam_serial, ext1_cam_extrinsics, ...
    LAB/success/DATE/TIME/trajectory.h5                 observation/robot_state/joint_positions
    LAB/success/DATE/TIME/recordings/MP4/SERIAL.mp4     one frame for each step

The stated pose is that of the left lens. The intrinsics are in the SVO files of the cameras, so
they are given: a camera file, or the `intrinsics.json` that was published later for all episodes.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from evercal.bounds import require_at_most
from evercal.errors import InputError, optional_module
from evercal.geometry import Camera
from evercal.recordings.cameras.camera_file import read_camera
from evercal.recordings.episodes.episode import (
    Episode,
    frames_of,
    slow_rows,
    values_of_joints,
)
from evercal.recordings.formats.video_file import VideoFrame, Videos
from evercal.recordings.read_options import ReadOptions
from evercal.robot.robot_model import RobotModel
from evercal.storage.text_files import library_errors, path_inside, read_json
from evercal.typing import Array, JsonObject

_METADATA = "metadata_*.json"
_CAMERAS = ("ext1", "ext2")
"""Fixed cameras; the third is on the wrist."""
_JOINTS = "observation/robot_state/joint_positions"


def episodes(
    root: Path, model: RobotModel, camera: Path, options: ReadOptions, images: int
) -> tuple[int, Iterator[Episode]]:
    """See `episodes_in`."""
    files = sorted(root.rglob(_METADATA))
    if not files:
        raise InputError(
            f"{root}: no data set; give the folder of meta/info.json (LeRobot), or one with"
            f" {_METADATA} in the folders of its episodes (DROID)"
        )
    entries: JsonObject = {}
    if camera.suffix == ".json":
        entries = read_json(camera, "camera file")
    lens = None
    if "cameraMatrix" not in str(next(iter(entries.values()), "")):
        lens = read_camera(camera)

    def each() -> Iterator[Episode]:
        for file in files:
            name = file.stem.removeprefix("metadata_")
            try:
                with library_errors(f"{file}: does not describe an episode of DROID"):
                    found = [*_of(file, name)]
            except InputError as error:
                found = [Episode(name, problem=str(error))]
            yield from found

    def _of(file: Path, name: str) -> Iterator[Episode]:
        data = read_json(file, "episode")
        stated = {}
        for number in _CAMERAS:
            pose = tuple(map(float, data[f"{number}_cam_extrinsics"]))
            stated[str(data[f"{number}_cam_serial"])] = pose
        values = joint_values(file.parent / "trajectory.h5")
        names, values = values_of_joints(
            model, [""] * values.shape[1], values, options.pose_convention
        )
        chosen = slow_rows(values, images)
        for serial in stated:
            video = file.parent / path_inside(f"recordings/MP4/{serial}.mp4", serial)
            videos = Videos.of(video)
            stored = [VideoFrame(videos, video, i * videos.step_s) for i in chosen]
            own = lens or _camera(camera, entries, name, serial)
            frames = frames_of(stored, values[chosen], own)
            yield Episode(name, serial, frames, names, stated)

    return len(files) * len(_CAMERAS), each()


def _camera(file: Path, entries: JsonObject, episode: str, serial: str) -> Camera:
    entry = entries.get(episode, {}).get(serial)
    if entry is None:
        raise InputError(f"{file}: has no camera {serial} of {episode}")
    fx, cx, fy, cy = map(float, entry["cameraMatrix"])
    return Camera(entry["width"], entry["height"], fx, fy, cx, cy)


def joint_values(file: Path) -> Array:
    """(n, k) joint values of a trajectory."""
    h5py = optional_module("h5py", f"{file}: DROID's files need h5py", "droid")
    with library_errors(f"{file}: cannot be read"), h5py.File(file) as trajectory:
        values = trajectory[_JOINTS]
        require_at_most(values.size, "numbers", "joint values")
        if values.file != trajectory or values.external or values.is_virtual:
            raise ValueError(f"{_JOINTS} lies in another file")
        values = np.array(values, float)
    if values.ndim != 2 or not len(values) or not np.isfinite(values).all():
        raise InputError(f"{file}: {_JOINTS} holds no rows of finite numbers")
    return values
