"""LeRobot datasets, versions 2 and 3, with images as videos or in the tables (extra `lerobot`).

    ROOT/meta/info.json                                       features, frame rate, paths
    ROOT/data/chunk-000/episode_000000.parquet                version 2: one file per episode
    ROOT/videos/chunk-000/KEY/episode_000000.mp4
    ROOT/data/chunk-000/file-000.parquet                      version 3: several episodes per file
    ROOT/meta/episodes/chunk-000/file-000.parquet, ROOT/videos/KEY/chunk-000/file-000.mp4

Poses are read from the features, see `lerobot_poses`. The format has no intrinsics, so a camera
file is required. Frames of all episodes are training frames with base_from_gripper. Paths in the
dataset must stay inside its folder.
"""

import functools
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError, missing_extra
from evercal.recordings.formats.lerobot_poses import feature_poses, pose_feature
from evercal.recordings.formats.video_file import VideoFrame, Videos
from evercal.recordings.frame import Frame, Recording
from evercal.recordings.images import StoredImage, decode_image, image_file
from evercal.recordings.poses.camera_file import read_camera_of_size
from evercal.recordings.read_options import ReadOptions
from evercal.recordings.text_files import path_inside, read_json

USES = ("camera", "image_topic", "base_frame", "gripper_frame", "urdf", "pose_convention")
INFO = Path("meta") / "info.json"


def detect(root: Path) -> bool:
    """Whether `root` holds a LeRobot dataset."""
    with suppress(OSError):
        return b"codebase_version" in (root / INFO).read_bytes()
    return False


def load(root: Path, options: ReadOptions | None = None) -> Recording:
    """Read the tables and decode one image; the others stay in their files until needed."""
    root = Path(root)
    try:
        return _load(root, options or ReadOptions())
    except (KeyError, TypeError, ValueError, IndexError, OverflowError, AttributeError) as error:
        # Features of many kinds are described in one file that other programs write.
        reason = f"{type(error).__name__}: {error}"
        raise InputError(f"{root / INFO}: does not describe the dataset ({reason})") from error


def _load(root: Path, options: ReadOptions) -> Recording:
    info = _info(root)
    key = _camera_key(root, info, options.image_topic)
    if options.camera is None:
        raise InputError(
            f"{root}: LeRobot datasets hold no intrinsics; give them with --camera FILE"
        )
    shape = [int(n) for n in info["features"][key]["shape"]]
    height, width = shape[1:3] if shape[0] == 3 else shape[:2]  # some state channels first
    camera = read_camera_of_size(options.camera, (width, height), key)
    column = pose_feature(root, info, options)
    rows, values = _rows(root, column)
    poses, notes = feature_poses(root, info, column, values, options)
    frames = tuple(
        Frame(f"episode_{row.episode:06d}/{row.number:06d}", image, camera, None, pose)
        for row, image, pose in zip(rows, _images(root, info, key, rows), poses, strict=True)
    )
    here, total = len({row.episode for row in rows}), int(info.get("total_episodes", 0))
    if here < total:
        notes.append(f"{here} of {total} episodes are in the folder")
    frames[0].read_image()
    return Recording(root.resolve().name, frames, (), notes=tuple(notes))


def _info(root: Path) -> dict[str, Any]:
    info: dict[str, Any] = read_json(root / INFO, "LeRobot dataset")
    version, features = str(info["codebase_version"]), info["features"]
    if not version.startswith(("v2.", "v3.")):
        raise InputError(f"{root / INFO}: version {version}; this evercal reads v2 and v3")
    if not all(isinstance(f, dict) for f in features.values()) or not float(info["fps"]) > 0:
        raise ValueError("'features' is an object of objects and 'fps' a number > 0")
    for name in ("data_path", "video_path"):
        if info.get(name) is not None:
            path_inside(info[name], repr(name))
    return info


def _camera_key(root: Path, info: Mapping[str, Any], wanted: str | None) -> str:
    keys = [k for k, f in info["features"].items() if f.get("dtype") in ("video", "image")]
    if wanted is None and len(keys) == 1:
        return keys[0]
    if wanted in keys:
        return str(wanted)
    what = f"no camera {wanted!r}" if wanted else f"{len(keys)} cameras"
    raise InputError(f"{root}: {what}; name one with --image-topic: {', '.join(keys) or 'none'}")


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


def _rows(root: Path, column: str) -> tuple[list[_Row], NDArray[np.float64]]:
    """The n rows of all episodes, and (n, k) numbers of the pose feature."""
    files = sorted((root / "data").glob("*/*.parquet"))
    if not files:
        raise InputError(
            f"{root / 'data'}: no parquet files; download the dataset's data folder too"
        )
    rows: list[_Row] = []
    parts = []
    for file in files:
        *cells, poses = _columns(file, ["episode_index", "frame_index", "timestamp", column])
        for i, (episode, number, seconds) in enumerate(zip(*cells, strict=True)):
            rows.append(_Row(episode, number, seconds, file, i))
        values = np.empty(0)
        with suppress(TypeError, ValueError):
            values = np.array(poses, dtype=np.float64)
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
    images: list[StoredImage] = []
    for row in rows:
        if row.episode not in starts:
            raise InputError(f"{root / 'meta' / 'episodes'}: episode {row.episode} is not listed")
        path, start = starts[row.episode]
        images.append(VideoFrame(videos, path, start + row.seconds))
    return images


def _video_starts(
    root: Path, info: Mapping[str, Any], key: str, episodes: set[int]
) -> dict[int, tuple[Path, float]]:
    """By episode: its video, and the time in the video at which it starts."""
    starts = {}
    if str(info["codebase_version"]).startswith("v2"):
        for episode in episodes:
            chunk = episode // int(info.get("chunks_size", 1000))
            numbers = {"episode_chunk": chunk, "episode_index": episode}
            starts[episode] = _video_path(root, info, key, numbers), 0.0
        return starts
    parts = ("chunk_index", "file_index", "from_timestamp")
    names = ["episode_index", *(f"videos/{key}/{part}" for part in parts)]
    for file in sorted((root / "meta" / "episodes").glob("*/*.parquet")):
        for episode, chunk, number, start in zip(*_columns(file, names), strict=True):
            numbers = {"chunk_index": chunk, "file_index": number}
            starts[int(episode)] = _video_path(root, info, key, numbers), float(start)
    return starts


def _video_path(root: Path, info: Mapping[str, Any], key: str, numbers: dict[str, int]) -> Path:
    path = str(info["video_path"]).format(video_key=key, **numbers)
    return root / path_inside(path, "'video_path'")


def _parquet(path: Path) -> Any:
    try:
        import pyarrow.parquet as parquet  # pyright: ignore[reportMissingImports]
    except ImportError:
        need = f"{path}: LeRobot datasets need pyarrow and PyAV"
        raise missing_extra(need, "lerobot") from None
    return parquet


def _columns(file: Path, names: list[str]) -> list[list[Any]]:
    parquet = _parquet(file)
    try:
        table = parquet.read_table(file, columns=names)
        return [table[name].to_pylist() for name in names]
    except Exception as error:  # pyarrow raises many types for damaged files
        raise _unreadable(file, error) from None


def _unreadable(file: Path, error: Exception) -> InputError:
    return InputError(f"{file}: cannot be read: {' '.join(str(error).split())[:200]}")


@functools.lru_cache(maxsize=1)
def _row_group(path: Path, group: int, key: str) -> list[Any]:
    with _parquet(path).ParquetFile(path) as file:
        return file.read_row_group(group, columns=[key])[key].to_pylist()


@dataclass(frozen=True, eq=False)
class _Embedded(StoredImage):
    """An image file in a cell of a table."""

    root: Path
    key: str
    path: Path
    row: int

    def read(self) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 RGB."""
        image = decode_image(np.frombuffer(self._content(), np.uint8))
        if image is None:
            raise InputError(f"{self.path}: row {self.row} holds no image")
        return image

    def file(self) -> tuple[str, bytes] | None:
        """The PNG or JPEG file as it is stored."""
        return image_file(self._content())

    def _content(self) -> bytes:
        parquet = _parquet(self.path)
        try:
            with parquet.ParquetFile(self.path) as file:
                groups = range(file.num_row_groups)
                ends = np.cumsum([file.metadata.row_group(group).num_rows for group in groups])
            group = int(np.searchsorted(ends, self.row, side="right"))
            cell = _row_group(self.path, group, self.key)[self.row - int(ends[group])]
        except Exception as error:
            raise _unreadable(self.path, error) from None
        if cell["bytes"]:
            return bytes(cell["bytes"])
        where = f"{self.path}: row {self.row}: image {cell['path']!r}"
        try:
            return (self.root / path_inside(cell["path"], "the path")).read_bytes()
        except ValueError as error:
            raise InputError(f"{where}: {error}") from None
        except OSError as error:
            raise InputError(f"{where} cannot be read ({error.strerror})") from None
