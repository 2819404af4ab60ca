"""LeRobot datasets, versions 2 and 3, with images as videos or in the tables (extra `lerobot`).

    ROOT/meta/info.json                                       features, frame rate, paths
    ROOT/data/chunk-000/episode_000000.parquet                version 2: one file per episode
    ROOT/videos/chunk-000/KEY/episode_000000.mp4
    ROOT/data/chunk-000/file-000.parquet                      version 3: several episodes per file
    ROOT/meta/episodes/chunk-000/file-000.parquet, ROOT/videos/KEY/chunk-000/file-000.mp4

The format has no intrinsics, so a camera file is required. Frames of all episodes are training
frames with base_from_gripper. Paths in the dataset must stay inside its folder.
"""

import functools
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evercal.classes import frozen_arrays
from evercal.errors import InputError, optional_module
from evercal.recordings.cameras.camera_file import read_camera_of_size
from evercal.recordings.formats.lerobot_poses import feature_poses, pose_feature
from evercal.recordings.formats.video_file import VideoFrame, Videos
from evercal.recordings.frame import Frame, Recording
from evercal.recordings.images import (
    ImageFile,
    StoredImage,
    decode_image,
    files_in,
    image_file,
)
from evercal.recordings.poses.row_files import number_array
from evercal.recordings.read_options import ReadOptions
from evercal.storage.text_files import (
    library_errors,
    named_errors,
    path_inside,
    read_json,
)
from evercal.typing import Array, Image, Record, Size

INFO = Path("meta") / "info.json"


def detect(root: Path) -> bool:
    """Whether `root` holds a LeRobot dataset."""
    with suppress(OSError):
        return b"codebase_version" in (root / INFO).read_bytes()
    return False


def load(root: Path, options: ReadOptions) -> Recording:
    """Read the tables and decode one image; the others stay in their files until needed."""
    # Features of many kinds are described in one file that other programs write.
    with library_errors(f"{root / INFO}: does not describe the dataset"):
        return _load(root, options)


def _load(root: Path, options: ReadOptions) -> Recording:
    info = dataset_info(root)
    key = camera_key(root, info, options.image_topic)
    if not options.camera:
        raise InputError(
            f"{root}: LeRobot datasets hold no intrinsics; give them with `camera`"
        )
    camera = read_camera_of_size(options.camera, image_size_of(info, key), key)
    column = pose_feature(root, info, options)
    rows: list[Row] = []
    tables = []
    for file in data_files(root):
        found, values = rows_in(file, column)
        rows += found
        tables.append(values)
    if not rows:
        raise InputError(f"{root}: the dataset has no frames")
    values = np.concatenate(tables)
    stated, notes = feature_poses(root, info, column, values, options)
    frames = []
    for i, image in enumerate(images_of(root, info, key, rows)):
        row = rows[i]
        name = f"episode_{row.episode:06d}/{row.number:06d}"
        joints = stated.joints_of(i)
        frames.append(
            Frame(name, image, camera, None, stated.poses[i], joints_rad=joints)
        )
    episodes = len({row.episode for row in rows})
    total = int(info.get("total_episodes", 0))
    if episodes < total:
        notes.append(f"{episodes} of {total} episodes are in the folder")
    frames[0].read_image()
    name = root.resolve().name
    return Recording(
        name,
        tuple(frames),
        (),
        notes=tuple(notes),
        arm=stated.arm,
        frames=stated.frames,
    )


def dataset_info(root: Path) -> Record:
    """The content of info.json; versions and paths that are not read are refused."""
    info: Record = read_json(root / INFO, "LeRobot dataset")
    version = str(info["codebase_version"])
    features = info["features"]
    if not version.startswith(("v2.", "v3.")):
        raise InputError(
            f"{root / INFO}: version {version}; this evercal reads v2 and v3"
        )
    are_objects = all(isinstance(feature, dict) for feature in features.values())
    if not are_objects or not float(info["fps"]) > 0:
        raise ValueError("'features' is an object of objects and 'fps' a number > 0")
    for name in ("data_path", "video_path"):
        if info.get(name) is not None:
            path_inside(info[name], repr(name))
    return info


def image_size_of(info: Record, key: str) -> Size:
    """Width and height of the images of a feature."""
    shape = [int(n) for n in info["features"][key]["shape"]]
    if shape[0] == 3:  # some state channels first
        shape = shape[1:]
    height, width = shape[:2]
    return width, height


def camera_key(root: Path, info: Record, wanted: str | None) -> str:
    """The feature of the images that are wanted, or the only one."""
    keys = picture_keys(info)
    if wanted is None and len(keys) == 1:
        return keys[0]
    if wanted in keys:
        return str(wanted)
    what = f"no picture in {wanted!r}" if wanted else f"{len(keys)} cameras"
    raise InputError(
        f"{root}: {what}; name one with `image_topic`: {', '.join(keys) or 'none'}"
    )


def picture_keys(info: Record) -> list[str]:
    """Features of colour images."""
    keys = []
    for key, feature in info["features"].items():
        # Stated in `info`, in older versions under other names.
        is_depth = re.search(r"is_depth_map'\W+True", str(feature))
        if feature.get("dtype") in ("video", "image") and not is_depth:
            keys.append(key)
    return keys


class Row(NamedTuple):
    """One image and its place in the tables."""

    episode: int
    number: int
    """Index of the frame in its episode."""
    seconds: float
    """Time since the start of the episode."""
    file: Path
    row: int
    """Index of the row in `file`."""


def data_files(root: Path) -> list[Path]:
    """Tables of the rows."""
    files = files_in(root / "data", (".parquet",), "*/*")
    if not files:
        raise InputError(
            f"{root / 'data'}: no parquet files; download the data folder too"
        )
    return files


def rows_in(file: Path, column: str) -> tuple[list[Row], Array]:
    """Rows of a table, and (n, k) numbers of a feature."""
    names = ["episode_index", "frame_index", "timestamp", column]
    *cells, poses = columns(file, names)
    rows = []
    for i, (episode, number, seconds) in enumerate(zip(*cells, strict=True)):
        rows.append(Row(episode, number, seconds, file, i))
    with named_errors(file, column):
        values = number_array(poses, column)
    if values.ndim != 2 or not np.isfinite(values).all():
        raise InputError(f"{file}: {column} holds no rows of finite numbers")
    return rows, values


def images_of(
    root: Path, info: Record, key: str, rows: Sequence[Row]
) -> list[StoredImage]:
    """The images of a camera at some rows."""
    if info["features"][key]["dtype"] == "image":
        return [_Embedded(root, key, row.file, row.row) for row in rows]
    videos = Videos(float(info["fps"]))
    template = str(info["video_path"])
    starts: dict[int, tuple[Path, float]] = {}
    if str(info["codebase_version"]).startswith("v2"):
        size = int(info.get("chunks_size", 1000))
        for i in {row.episode for row in rows}:
            path = _video(
                root, template, video_key=key, episode_chunk=i // size, episode_index=i
            )
            starts[i] = (path, 0.0)
    else:
        starts = _video_starts(root, template, key)
    frames: list[StoredImage] = []
    for row in rows:
        if row.episode not in starts:
            raise InputError(
                f"{root / 'meta' / 'episodes'}: episode {row.episode} is not listed"
            )
        path, start = starts[row.episode]
        frames.append(VideoFrame(videos, path, start + row.seconds))
    return frames


@functools.lru_cache(maxsize=4)
def _video_starts(root: Path, template: str, key: str) -> dict[int, tuple[Path, float]]:
    """By episode of version 3: its video, and the time in the video at which it starts."""
    starts: dict[int, tuple[Path, float]] = {}
    parts = ("chunk_index", "file_index", "from_timestamp")
    names = ["episode_index", *(f"videos/{key}/{part}" for part in parts)]
    for file in files_in(root / "meta" / "episodes", (".parquet",), "*/*"):
        for episode, chunk, number, start in zip(*columns(file, names), strict=True):
            path = _video(
                root, template, video_key=key, chunk_index=chunk, file_index=number
            )
            starts[int(episode)] = (path, float(start))
    return starts


def _video(root: Path, template: str, **fields: object) -> Path:
    def field(match: re.Match[str]) -> str:
        width = int(match[2] or 0)
        return str(fields[match[1]]).zfill(width)

    # Not by `str.format`, where the dataset would choose widths without limit.
    path = re.sub(r"\{(\w+)(?::0(\d)d)?\}", field, template)
    return root / path_inside(path, "'video_path'")


@contextmanager
def _parquet(path: Path) -> Iterator[Any]:
    """An open table."""
    need = f"{path}: LeRobot datasets need pyarrow and PyAV"
    parquet = optional_module("pyarrow.parquet", need, "lerobot")
    with library_errors(f"{path}: cannot be read"), parquet.ParquetFile(path) as table:
        yield table


def columns(file: Path, names: list[str]) -> list[list[Any]]:
    """Some columns of a table."""
    with _parquet(file) as table:
        read = table.read(columns=names)
        return [read[name].to_pylist() for name in names]


@functools.lru_cache(maxsize=1)
def _row_group(path: Path, group: int, key: str) -> list[Any]:
    with _parquet(path) as table:
        return table.read_row_group(group, columns=[key])[key].to_pylist()


@frozen_arrays
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

    def file(self) -> ImageFile | None:
        """The PNG or JPEG file as it is stored."""
        return image_file(self._content())

    def _content(self) -> bytes:
        row = self.row
        group = 0
        with _parquet(self.path) as table:
            while row >= table.metadata.row_group(group).num_rows:
                row -= table.metadata.row_group(group).num_rows
                group += 1
            cell = _row_group(self.path, group, self.key)[row]
        if cell["bytes"]:
            return bytes(cell["bytes"])
        where = f"{self.path}: row {self.row}: image {cell['path']!r}"
        with named_errors(where, "file"):
            return (self.root / path_inside(cell["path"], "the path")).read_bytes()
