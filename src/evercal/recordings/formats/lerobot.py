"""LeRobot datasets, versions 2 and 3, with images as videos or in the tables (extra `lerobot`).

    ROOT/meta/info.json                                       features, frame rate, paths
    ROOT/data/chunk-000/episode_000000.parquet                version 2: one file an episode
    ROOT/videos/chunk-000/KEY/episode_000000.mp4
    ROOT/data/chunk-000/file-000.parquet                      version 3: several in a file
    ROOT/meta/episodes/chunk-000/file-000.parquet, ROOT/videos/KEY/chunk-000/file-000.mp4

Poses come from the features, see `lerobot_poses`. The format has no place for intrinsics: a camera
file has to be given. Frames of all episodes are training frames with base_from_gripper.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.recordings.formats.lerobot_poses import feature_poses, pose_feature
from evercal.recordings.formats.video_file import VideoFrame, Videos
from evercal.recordings.frame import Frame, Recording
from evercal.recordings.images import StoredImage, decode_image, image_file
from evercal.recordings.poses.camera_file import read_camera
from evercal.recordings.read_options import ReadOptions

USES = ("camera", "image_topic", "base_frame", "gripper_frame", "urdf", "pose_convention")
INFO = Path("meta") / "info.json"


def detect(root: Path) -> bool:
    """Whether `root` holds a LeRobot dataset."""
    try:
        return b"codebase_version" in (root / INFO).read_bytes()
    except OSError:
        return False


def load(root: Path, options: ReadOptions | None = None) -> Recording:
    """Reads the tables and decodes one image; the others stay in their files until needed.

    Raises:
        InputError: The extra `lerobot` is not installed, a file is missing or broken, the dataset
            is of another version, or nothing in it says where the gripper was.
    """
    root, options = Path(root), options or ReadOptions()
    info = _info(root)
    key = _camera_key(root, info, options.image_topic)
    if options.camera is None:
        raise InputError(
            f"{root}: LeRobot datasets hold no intrinsics; give them with --camera FILE"
        )
    height, width = (int(n) for n in info["features"][key]["shape"][:2])
    if height == 3:  # some datasets state channels first
        height, width = (int(n) for n in info["features"][key]["shape"][1:3])
    camera = read_camera(options.camera, (width, height))
    if (camera.width, camera.height) != (width, height):
        raise InputError(
            f"{options.camera}: is for images of {camera.width}x{camera.height}, {key} is"
            f" {width}x{height}; give the intrinsics of this image size"
        )
    column = pose_feature(root, info, options)
    table = _table(root, info, column)
    poses, notes = feature_poses(root, info, column, table.values, options)
    images = _images(root, info, key, table)
    frames = tuple(
        Frame(f"episode_{episode:06d}/{number:06d}", image, camera, None, pose)
        for episode, number, image, pose in zip(
            table.episode, table.number, images, poses, strict=True
        )
    )
    here, total = len(set(table.episode.tolist())), int(info.get("total_episodes", 0))
    if here < total:
        notes.append(f"{here} of {total} episodes are in the folder")
    frames[0].read_image()
    return Recording(root.resolve().name, frames, (), notes=tuple(notes))


def _info(root: Path) -> dict[str, Any]:
    file = root / INFO
    try:
        info = json.loads(file.read_bytes())
        version = str(info["codebase_version"])
        if not version.startswith(("v2.", "v3.")):
            raise InputError(f"{file}: version {version}; this evercal reads v2 and v3")
        if not isinstance(info["features"], dict) or not float(info["fps"]) > 0:
            raise ValueError("'features' is an object and 'fps' a number > 0")
        return info
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror})") from None
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{file}: no LeRobot dataset ({type(error).__name__}: {error})") from None


def _camera_key(root: Path, info: Mapping[str, Any], wanted: str | None) -> str:
    keys = [k for k, f in info["features"].items() if f.get("dtype") in ("video", "image")]
    if wanted is None and len(keys) == 1:
        return keys[0]
    if wanted in keys:
        return str(wanted)
    what = f"no camera {wanted!r}" if wanted else f"{len(keys)} cameras"
    raise InputError(f"{root}: {what}; name one with --image-topic: {', '.join(keys) or 'none'}")


@dataclass(frozen=True, eq=False)
class _Table:
    """The rows of all episodes."""

    files: list[Path]
    file: NDArray[np.int64]
    row: NDArray[np.int64]
    episode: NDArray[np.int64]
    number: NDArray[np.int64]
    seconds: NDArray[np.float64]
    values: NDArray[np.float64]


def _table(root: Path, info: Mapping[str, Any], column: str) -> _Table:
    parquet = _parquet(root)
    files = sorted((root / "data").glob("*/*.parquet"))
    if not files:
        raise InputError(
            f"{root / 'data'}: no parquet files; download the dataset's data folder too"
        )
    parts: list[list[NDArray[Any]]] = []
    for i, file in enumerate(files):
        columns = ["episode_index", "frame_index", "timestamp", column]
        try:
            read = parquet.read_table(file, columns=columns)
            episode, number, seconds = (read[name].to_numpy() for name in columns[:3])
            values = np.array(read[column].to_pylist(), dtype=np.float64)
        except Exception as error:  # pyarrow raises many kinds for damaged files
            text = " ".join(str(error).split())[:200]
            raise InputError(f"{file}: cannot be read: {text}") from None
        if values.ndim != 2 or not np.isfinite(values).all():
            raise InputError(f"{file}: {column} holds no rows of finite numbers")
        where = np.full(len(values), i)
        parts.append([where, np.arange(len(values)), episode, number, seconds, values])
    where, row, episode, number, seconds, values = (
        np.concatenate(part) for part in zip(*parts, strict=True)
    )
    if not len(values):
        raise InputError(f"{root}: the dataset has no frames")
    return _Table(files, where, row, episode, number, seconds.astype(np.float64), values)


def _parquet(root: Path) -> Any:
    try:
        import pyarrow.parquet as parquet  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputError(
            f"{root}: LeRobot datasets need pyarrow and PyAV; run: pip install 'evercal[lerobot]'"
        ) from None
    return parquet


def _images(
    root: Path, info: Mapping[str, Any], key: str, table: _Table
) -> list[StoredImage]:  # fmt: skip
    rows = range(len(table.row))
    if info["features"][key]["dtype"] == "image":
        tables = _Tables(root, key)
        return [_Embedded(tables, table.files[table.file[i]], int(table.row[i])) for i in rows]
    videos = Videos(float(info["fps"]))
    begins = _begins(root, info, key) if str(info["codebase_version"]).startswith("v3") else None
    found: list[StoredImage] = []
    for i in rows:
        episode = int(table.episode[i])
        if begins is None:
            path = str(info["video_path"]).format(
                episode_chunk=episode // int(info["chunks_size"]),
                video_key=key,
                episode_index=episode,
            )
            begin = 0.0
        elif episode in begins:
            path, begin = begins[episode]
        else:
            raise InputError(f"{root / 'meta' / 'episodes'}: episode {episode} is not listed")
        found.append(VideoFrame(videos, root / path, begin + float(table.seconds[i])))
    return found


def _begins(root: Path, info: Mapping[str, Any], key: str) -> dict[int, tuple[str, float]]:
    """By episode of version 3: its video and the time in it at which the episode begins."""
    found = {}
    parts = ("chunk_index", "file_index", "from_timestamp")
    names = ["episode_index", *(f"videos/{key}/{part}" for part in parts)]
    for file in sorted((root / "meta" / "episodes").glob("*/*.parquet")):
        try:
            rows = _parquet(root).read_table(file, columns=names).to_pylist()
        except Exception as error:  # pyarrow raises many kinds for damaged files
            text = " ".join(str(error).split())[:200]
            raise InputError(f"{file}: cannot be read: {text}") from None
        for row in rows:
            episode, chunk, number, begin = (row[name] for name in names)
            path = str(info["video_path"]).format(
                video_key=key, chunk_index=chunk, file_index=number
            )
            found[int(episode)] = path, float(begin)
    return found


class _Tables:
    """The images in parquet files, the last row group of which is kept."""

    def __init__(self, root: Path, key: str) -> None:
        self._parquet, self._key, self._root = _parquet(root), key, root
        self._last: tuple[Path, int, list[Any]] | None = None

    def bytes(self, path: Path, row: int) -> bytes:
        """The image file in a row."""
        file = self._parquet.ParquetFile(path)
        try:
            group = 0
            while row >= file.metadata.row_group(group).num_rows:
                row -= file.metadata.row_group(group).num_rows
                group += 1
            last = self._last
            if last is None or last[:2] != (path, group):
                rows = file.read_row_group(group, columns=[self._key])[self._key].to_pylist()
                last = self._last = path, group, rows
        finally:
            file.close()
        cell = last[2][row]
        if cell["bytes"]:
            return bytes(cell["bytes"])
        try:
            return (self._root / cell["path"]).read_bytes()
        except OSError as error:
            where = f"{path}: row {row}: image {cell['path']!r}"
            raise InputError(f"{where} cannot be read ({error.strerror})") from None


@dataclass(frozen=True, eq=False)
class _Embedded(StoredImage):
    """An image file in a cell of a table."""

    tables: _Tables
    path: Path
    row: int

    def read(self) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 RGB."""
        image = decode_image(np.frombuffer(self.tables.bytes(self.path, self.row), np.uint8))
        if image is None:
            raise InputError(f"{self.path}: row {self.row} holds no image")
        return image

    def file(self) -> tuple[str, bytes] | None:
        """The PNG or JPEG as it is stored."""
        return image_file(self.tables.bytes(self.path, self.row))
