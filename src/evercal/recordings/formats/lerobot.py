"""LeRobot datasets, versions 2 and 3, with images as videos or in the tables (extra `lerobot`).

    ROOT/meta/info.json                                       features, frame rate, paths
    ROOT/data/chunk-000/episode_000000.parquet                version 2: one file per episode
    ROOT/videos/chunk-000/KEY/episode_000000.mp4
    ROOT/data/chunk-000/file-000.parquet                      version 3: several episodes per file
    ROOT/meta/episodes/chunk-000/file-000.parquet, ROOT/videos/KEY/chunk-000/file-000.mp4

The format has no intrinsics, so a camera file is required. Frames of all episodes are training
frames with base_from_gripper. Paths in the dataset must stay inside its folder.

A pose is a feature whose names end in x, y, z and qx, qy, qz, qw, or wx, wy, wz for a rotation
vector; the first numbers of a feature in a convention that the user gives; or, with a URDF, the
joints of observation.state. `--gripper-frame` selects the feature if several hold poses, or the
arm, such as left_ee, if one feature holds left_ee.x and right_ee.x.
"""

import functools
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evercal.errors import InputError, optional_module
from evercal.recordings.cameras.camera_file import read_camera_of_size
from evercal.recordings.formats.video_file import VideoFrame, Videos
from evercal.recordings.frame import Frame, Recording
from evercal.recordings.images import StoredImage, decode_image, files_in, image_file
from evercal.recordings.poses.conventions import (
    asking_for,
    checked_poses,
    pose_convention,
)
from evercal.recordings.poses.joint_tables import in_radians, poses_of_arm
from evercal.recordings.poses.robot_poses import RobotPoses
from evercal.recordings.poses.row_files import number_array
from evercal.recordings.read_options import ReadOptions
from evercal.robot.robot_model import RobotModel
from evercal.storage.text_files import (
    library_errors,
    named_errors,
    path_inside,
    read_json,
    refuse_repeated,
)
from evercal.typing import Array, Image

USES = (
    "camera",
    "image_topic",
    "base_frame",
    "gripper_frame",
    "urdf",
    "pose_convention",
)
INFO = Path("meta") / "info.json"
_STATE = "observation.state"
# Names of the numbers of a pose, by convention.
_PARTS = {
    "xyzw": ("x", "y", "z", "qx", "qy", "qz", "qw"),
    "ur": ("x", "y", "z", "wx", "wy", "wz"),
}


def detect(root: Path) -> bool:
    """Whether `root` holds a LeRobot dataset."""
    with suppress(OSError):
        return b"codebase_version" in (root / INFO).read_bytes()
    return False


def load(root: Path, options: ReadOptions | None = None) -> Recording:
    """Read the tables and decode one image; the others stay in their files until needed."""
    # Features of many kinds are described in one file that other programs write.
    with library_errors(f"{root / INFO}: does not describe the dataset"):
        return _load(root, options or ReadOptions())


def _load(root: Path, options: ReadOptions) -> Recording:
    info = _info(root)
    key = _camera_key(root, info, options.image_topic)
    if options.camera is None:
        raise InputError(
            f"{root}: LeRobot datasets hold no intrinsics; give them with --camera"
        )
    shape = [int(n) for n in info["features"][key]["shape"]]
    # Some state channels first.
    height, width = shape[1:3] if shape[0] == 3 else shape[:2]
    camera = read_camera_of_size(options.camera, (width, height), key)
    column = _pose_feature(root, info, options)
    rows, values = _rows(root, column)
    stated, notes = _feature_poses(root, info, column, values, options)
    names = [f"episode_{row.episode:06d}/{row.number:06d}" for row in rows]
    frames = tuple(
        Frame(
            name, image, camera, None, stated.poses[i], joints_rad=stated.joints_of(i)
        )
        for i, (name, image) in enumerate(
            zip(names, _images(root, info, key, rows), strict=True)
        )
    )
    here = len({row.episode for row in rows})
    total = int(info.get("total_episodes", 0))
    if here < total:
        notes.append(f"{here} of {total} episodes are in the folder")
    frames[0].read_image()
    return Recording(
        root.resolve().name, frames, (), notes=tuple(notes), arm=stated.arm
    )


def _info(root: Path) -> dict[str, Any]:
    info: dict[str, Any] = read_json(root / INFO, "LeRobot dataset")
    version = str(info["codebase_version"])
    features = info["features"]
    if not version.startswith(("v2.", "v3.")):
        raise InputError(
            f"{root / INFO}: version {version}; this evercal reads v2 and v3"
        )
    if (
        not all(isinstance(f, dict) for f in features.values())
        or not float(info["fps"]) > 0
    ):
        raise ValueError("'features' is an object of objects and 'fps' a number > 0")
    for name in ("data_path", "video_path"):
        if info.get(name) is not None:
            path_inside(info[name], repr(name))
    return info


def _camera_key(root: Path, info: Mapping[str, Any], wanted: str | None) -> str:
    keys = [
        k for k, f in info["features"].items() if f.get("dtype") in ("video", "image")
    ]
    # Stated in `info`, in older versions under other names.
    keys = [
        k
        for k in keys
        if not re.search(r"is_depth_map'\W+True", str(info["features"][k]))
    ]
    if wanted is None and len(keys) == 1:
        return keys[0]
    if wanted in keys:
        return str(wanted)
    what = f"no picture in {wanted!r}" if wanted else f"{len(keys)} cameras"
    raise InputError(
        f"{root}: {what}; name one with --image-topic: {', '.join(keys) or 'none'}"
    )


class _Row(NamedTuple):
    """One image and its place in the tables."""

    episode: int
    number: int
    """Index of the frame in its episode."""
    seconds: float
    """Time since the start of the episode."""
    file: Path
    row: int
    """Index of the row in `file`."""


def _rows(root: Path, column: str) -> tuple[list[_Row], Array]:
    files = files_in(root / "data", (".parquet",), "*/*")
    if not files:
        raise InputError(
            f"{root / 'data'}: no parquet files; download the data folder too"
        )
    rows: list[_Row] = []
    parts = []
    for file in files:
        *cells, poses = _columns(
            file, ["episode_index", "frame_index", "timestamp", column]
        )
        for i, (episode, number, seconds) in enumerate(zip(*cells, strict=True)):
            rows.append(_Row(episode, number, seconds, file, i))
        with named_errors(file, column):
            values = number_array(poses, column)
        if values.ndim != 2 or not np.isfinite(values).all():
            raise InputError(f"{file}: {column} holds no rows of finite numbers")
        parts.append(values)
    if not rows:
        raise InputError(f"{root}: the dataset has no frames")
    return rows, np.concatenate(parts)


def _images(
    root: Path, info: Mapping[str, Any], key: str, rows: Sequence[_Row]
) -> list[StoredImage]:
    if info["features"][key]["dtype"] == "image":
        return [_Embedded(root, key, row.file, row.row) for row in rows]
    videos = Videos(float(info["fps"]))
    starts = _video_starts(root, info, key, {row.episode for row in rows})
    if lost := sorted({row.episode for row in rows} - starts.keys()):
        raise InputError(
            f"{root / 'meta' / 'episodes'}: episode {lost[0]} is not listed"
        )
    places = [(row, *starts[row.episode]) for row in rows]
    return [
        VideoFrame(videos, path, start + row.seconds) for row, path, start in places
    ]


def _video_starts(
    root: Path, info: Mapping[str, Any], key: str, episodes: set[int]
) -> dict[int, tuple[Path, float]]:
    """By episode: its video, and the time in the video at which it starts."""

    def video(**fields: object) -> Path:
        def field(match: re.Match[str]) -> str:
            return str({"video_key": key, **fields}[match[1]]).zfill(int(match[2] or 0))

        # Not by `str.format`, where the dataset would choose widths without limit.
        path = re.sub(r"\{(\w+)(?::0(\d)d)?\}", field, str(info["video_path"]))
        return root / path_inside(path, "'video_path'")

    if str(info["codebase_version"]).startswith("v2"):
        size = int(info.get("chunks_size", 1000))
        return {
            i: (video(episode_chunk=i // size, episode_index=i), 0.0) for i in episodes
        }
    parts = ("chunk_index", "file_index", "from_timestamp")
    names = ["episode_index", *(f"videos/{key}/{part}" for part in parts)]
    return {
        int(episode): (video(chunk_index=chunk, file_index=number), float(start))
        for file in files_in(root / "meta" / "episodes", (".parquet",), "*/*")
        for episode, chunk, number, start in zip(*_columns(file, names), strict=True)
    }


@contextmanager
def _parquet(path: Path) -> Iterator[Any]:
    """An open table."""
    need = f"{path}: LeRobot datasets need pyarrow and PyAV"
    parquet = optional_module("pyarrow.parquet", need, "lerobot")
    with library_errors(f"{path}: cannot be read"), parquet.ParquetFile(path) as table:
        yield table


def _columns(file: Path, names: list[str]) -> list[list[Any]]:
    with _parquet(file) as table:
        read = table.read(columns=names)
        return [read[name].to_pylist() for name in names]


@functools.lru_cache(maxsize=1)
def _row_group(path: Path, group: int, key: str) -> list[Any]:
    with _parquet(path) as table:
        return table.read_row_group(group, columns=[key])[key].to_pylist()


@dataclass(frozen=True, eq=False)
class _Embedded(StoredImage):
    """An image file in a cell of a table."""

    root: Path
    key: str
    path: Path
    row: int

    def read(self) -> Image:
        """(H, W, 3) uint8 RGB."""
        image = decode_image(np.frombuffer(self._content(), np.uint8))
        if image is None:
            raise InputError(f"{self.path}: row {self.row} holds no image")
        return image

    def file(self) -> tuple[str, bytes] | None:
        """The PNG or JPEG file as it is stored."""
        return image_file(self._content())

    def _content(self) -> bytes:
        with _parquet(self.path) as table:
            groups = range(table.num_row_groups)
            ends = np.cumsum(
                [table.metadata.row_group(group).num_rows for group in groups]
            )
            group = int(np.searchsorted(ends, self.row, side="right"))
            cell = _row_group(self.path, group, self.key)[self.row - int(ends[group])]
        if cell["bytes"]:
            return bytes(cell["bytes"])
        where = f"{self.path}: row {self.row}: image {cell['path']!r}"
        with named_errors(where, "file"):
            return (self.root / path_inside(cell["path"], "the path")).read_bytes()


def _pose_feature(root: Path, info: Mapping[str, Any], options: ReadOptions) -> str:
    features = info["features"]
    if options.urdf is not None:
        return _STATE
    if options.pose_convention is not None:
        column = options.gripper_frame or _STATE
        if column not in features:
            names = ", ".join(features)
            raise InputError(
                f"{root}: no feature {column!r}; --gripper-frame is one of {names}"
            )
        return column
    observed = {
        key: _names(info, key) for key in features if key.startswith("observation")
    }
    keys = [key for key, names in observed.items() if _convention_of(names)]
    if options.gripper_frame is not None:
        keys = [
            key for key in keys if options.gripper_frame in (key, *_arms(observed[key]))
        ]
    if _STATE in keys or len(keys) == 1:
        return _STATE if _STATE in keys else keys[0]
    if keys:
        raise InputError(
            f"{root}: gripper poses are in {' and '.join(keys)}; give --gripper-frame"
        )
    named = {
        key: names for key, names in observed.items() if names and "image" not in key
    }
    listed = "; ".join(f"{key}: {', '.join(names)}" for key, names in named.items())
    raise InputError(
        f"{root}: no feature holds a pose (x, y, z and qx, qy, qz, qw or wx, wy, wz), there are"
        f" {listed or 'no named numbers'}; for joint angles give --urdf, for a pose in another form"
        f" --pose-convention and --gripper-frame FEATURE"
    )


def _feature_poses(
    root: Path,
    info: Mapping[str, Any],
    column: str,
    values: Array,
    options: ReadOptions,
) -> tuple[RobotPoses, list[str]]:
    names = _names(info, column)
    if options.urdf is not None:
        return _joint_poses(root, names, values, options)
    if options.base_frame is not None:
        raise InputError(f"{root}: --base-frame goes with --urdf only; leave it out")
    count = values.shape[1]
    notes = []
    with named_errors(f"{root}: {column}", "poses"), asking_for("--pose-convention"):
        if options.pose_convention is not None:
            convention = pose_convention(options.pose_convention)
            taken = convention.counts[-1]
            numbers = values[:, :taken]
            if taken < count:
                used = f" ({', '.join(names[:taken])})" if names else ""
                notes = [f"the first {taken} of its {count} numbers were taken{used}"]
        elif len(names) != count:
            raise ValueError(f"has {count} numbers and {len(names)} names")
        else:
            name, columns = _pose_columns(names, options.gripper_frame)
            convention = pose_convention(name)
            numbers = values[:, columns]
        poses = checked_poses(numbers, convention)
    notes = [f"gripper poses are {column}: {convention.meaning}", *notes]
    return RobotPoses(None, None, poses), notes


def _joint_poses(
    root: Path, names: list[str], stated: Array, options: ReadOptions
) -> tuple[RobotPoses, list[str]]:
    assert options.urdf is not None
    unit = options.pose_convention
    count = stated.shape[1]
    source = f"{root}: {_STATE}"
    if len(names) != count:
        raise InputError(f"{source} has {count} numbers and {len(names)} names")
    with named_errors(source, "names"):
        refuse_repeated(names, "rename the numbers")
    model = RobotModel(options.urdf)
    values = in_radians(model, names, stated, [unit] * count)
    moved = model.poses(
        names, values, options.base_frame, options.gripper_frame, source
    )
    return poses_of_arm(moved), moved.notes


def _pose_columns(names: list[str], arm: str | None) -> tuple[str, list[int]]:
    """Name of the convention of a pose, and its columns."""
    arms = _arms(names)
    chosen = _of_arm(names, arm) if arm in arms else names
    convention = _convention_of(chosen)
    assert convention is not None
    last = [name.rpartition(".")[2] for name in chosen]
    if any(last.count(part) > 1 for part in _PARTS[convention]):
        which = " or ".join(filter(None, arms))
        remedy = (
            f"--gripper-frame {which}"
            if which
            else "names that tell them apart in info.json"
        )
        raise ValueError(f"holds several poses ({', '.join(names)}); give {remedy}")
    return convention, [last.index(part) for part in _PARTS[convention]]


def _convention_of(names: list[str]) -> str | None:
    last = [name.rpartition(".")[2] for name in names]
    return next(
        (c for c, parts in _PARTS.items() if all(p in last for p in parts)), None
    )


def _arms(names: list[str]) -> list[str]:
    prefixes = dict.fromkeys(name.rpartition(".")[0] for name in names)
    return [arm for arm in prefixes if _convention_of(_of_arm(names, arm))]


def _of_arm(names: list[str], arm: str) -> list[str]:
    """The names of one arm, others as empty strings."""
    return [name if name.rpartition(".")[0] == arm else "" for name in names]


def _names(info: Mapping[str, Any], column: str) -> list[str]:
    names = info["features"].get(column, {}).get("names") or []
    # {"motors": [...]}, or several arms with the same names.
    if isinstance(names, dict):
        groups = {key: group for key, group in names.items() if isinstance(group, list)}
        names = [
            f"{key}.{name}" if len(groups) > 1 else name
            for key, group in groups.items()
            for name in group
        ]
    return [str(name).removesuffix(".pos") for name in names]
