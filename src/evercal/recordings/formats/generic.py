"""evercal's own folder format: one `scene.json` beside the images it names.

docs/formats.md lists the keys. `render` describes how a simulated scene was made. Unknown keys are
ignored.
"""

import contextlib
import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, Literal, Self, TypeAlias

import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3, Camera, pose_to_dict
from evercal.recordings.frame import Frame, Recording
from evercal.recordings.images import StoredImage, write_image
from evercal.robot.frame_names import FrameNames
from evercal.storage import write_json
from evercal.storage.records import of_format
from evercal.storage.text_files import (
    is_real,
    named_errors,
    naming,
    path_inside,
    read_json,
    refuse_repeated,
)
from evercal.typing import JsonObject, PathLike, Record

FILE = "scene.json"
"""File that lists the frames."""
_FORMAT = "evercal-scene"
_VERSION = 1
"""Version of the format of the file."""
Split: TypeAlias = Literal["train", "test"]
"""Part of a recording."""


def detect(root: Path) -> bool:
    """Whether `root` holds a scene.json."""
    return (root / FILE).is_file()


def load(root: Path) -> Recording:
    """Read scene.json; no image is opened."""
    file = root / FILE
    data = read_json(file, "scene file", "convert the recording again")
    with named_errors(file, "scene file"):
        frames = of_format(data, _FORMAT, _VERSION, partial(_frames, root))
        names = FrameNames.from_dict(data.get("frame_names", {}))
        notes = tuple(map(str, data.get("notes", ())))
    name = data.get("name")
    if not isinstance(name, str) or not name:
        name = root.resolve().name
    return Recording(
        name,
        tuple(frames["train"]),
        tuple(frames["test"]),
        data.get("untracked", 0),
        notes=notes,
        metric=data.get("unit") != "unknown",
        frames=names,
    )


def _frames(root: Path, data: Record) -> dict[Split, list[Frame]]:
    entries = data.get("frames")
    if not isinstance(entries, list) or not entries:
        raise ValueError("'frames' is a list with at least one frame")
    if not isinstance(data.get("untracked", 0), int):
        raise ValueError(f"'untracked' is a count, got {data['untracked']!r}")
    if data.get("unit", "metres") not in ("metres", "unknown"):
        raise ValueError(f"'unit' is 'metres' or 'unknown', got {data['unit']!r}")
    cameras = _cameras(data.get("cameras"))
    frames: dict[Split, list[Frame]] = {"train": [], "test": []}
    names = []
    for i, entry in enumerate(entries):
        with naming(f"frame {i}"):
            split, frame = _frame(root, entry, cameras)
        frames[split].append(frame)
        names.append(frame.name)
    refuse_repeated(names, "names of frames are unique")
    return frames


def write(
    root: PathLike,
    recording: Recording,
    *,
    link: bool = False,
    on_frame: Callable[[], object] = lambda: None,
) -> None:
    """Write a recording with its images; image files are copied byte for byte.

    Args:
        root: Folder to write to; created if missing.
        recording: Frames to write.
        link: Create hard links to image files where the file system allows it.
        on_frame: Called after every frame, for progress bars.
    """
    with SceneWriter(root, recording.name, link) as writer:
        writer.about = recording
        for split in ("train", "test"):
            for frame in getattr(recording, split):
                writer.add(frame, split)
                on_frame()


class SceneWriter:
    """Write frames one by one; scene.json is written last, if the `with` block ends without error.

    A folder without scene.json is therefore an interrupted recording, not a short scene. Arguments
    and errors are those of `write`.
    """

    def __init__(self, root: PathLike, name: str, link: bool = False) -> None:
        self.about = Recording(name, (), ())
        self.render: JsonObject | None = None
        self._root = Path(root)
        self._link = link
        self._cameras: dict[Camera, str] = {}
        self._entries: dict[str, JsonObject] = {}
        if (self._root / FILE).exists():
            raise InputError(f"{self._root / FILE}: already there; give a new folder")
        (self._root / "images").mkdir(parents=True, exist_ok=True)

    def __enter__(self) -> Self:
        """Return the writer; its folder exists already."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Write scene.json unless an error was raised."""
        if kind is not None:
            return
        about = self.about
        data: JsonObject = {
            "format": _FORMAT,
            "version": _VERSION,
            "name": about.name,
            "cameras": {
                number: camera.to_dict() for camera, number in self._cameras.items()
            },
            "frames": list(self._entries.values()),
            "untracked": about.untracked,
            "frame_names": vars(about.frames),
        }
        if not about.metric:
            data["unit"] = "unknown"
        if about.notes:
            data["notes"] = list(about.notes)
        if self.render is not None:
            data["render"] = self.render
        with self._new(FILE) as file:
            write_json(file, data)

    def add(self, frame: Frame, split: Split) -> None:
        """Write the frame's image and collect its entry of scene.json."""
        if frame.name in self._entries:
            raise InputError(
                f"frame {frame.name!r}: already written; frame names are unique"
            )
        # The counter keeps names like 'a/b' and 'a_b' apart and the folder in recorded order.
        stem = f"{len(self._entries):06d}"
        entry: JsonObject = {
            "name": frame.name,
            "image": self._write_image(frame, f"images/{stem}"),
            "camera": self._cameras.setdefault(frame.camera, str(len(self._cameras))),
            "split": split,
            "base_from_camera": pose_to_dict(frame.base_from_camera),
            "base_from_gripper": pose_to_dict(frame.base_from_gripper),
        }
        if frame.depth:
            entry["depth"] = f"depth/{stem}.png"
            (self._root / "depth").mkdir(exist_ok=True)
            self._copy(frame.depth, f"depth/{stem}.png")
        if frame.joints_rad is not None:
            entry["joints_rad"] = list(frame.joints_rad)
        self._entries[frame.name] = entry

    def _write_image(self, frame: Frame, stem: str) -> str:
        if isinstance(frame.image, Path):
            relative = stem + frame.image.suffix.lower()
            self._copy(frame.image, relative)
            return relative
        stored = None
        if isinstance(frame.image, StoredImage):
            stored = frame.image.file()
        if not stored:
            with self._new(f"{stem}.png") as path:
                write_image(path, frame.read_image())
        else:
            with self._new(stem + stored[0]) as path:
                path.write_bytes(stored[1])
        return f"images/{path.name}"

    def _copy(self, source: Path, relative: str) -> None:
        """Copy or link a file into the folder, unless it is that file already."""
        target = self._root / relative
        try:
            if target.exists() and target.samefile(source):
                return
            source.stat()
        except OSError as error:
            raise InputError(f"{source}: cannot be copied ({error.strerror})") from None
        with self._new(relative):
            if self._link:
                with contextlib.suppress(OSError):  # not every file system has links
                    # A link through a link would be broken once the folder moves.
                    return target.hardlink_to(source.resolve())
            shutil.copyfile(source, target)

    @contextlib.contextmanager
    def _new(self, relative: str) -> Iterator[Path]:
        """Path of a new file: writing to an old one could write through its hard links."""
        path = self._root / relative
        if path.exists():
            raise InputError(
                f"{path}: already there; give a new folder, or remove this one"
            )
        try:
            yield path
        except OSError as error:
            raise InputError(f"{path}: cannot be written ({error.strerror})") from None


def _cameras(data: object) -> dict[str, Camera]:
    if not isinstance(data, dict) or not {*map(type, data.values())} <= {dict}:
        raise ValueError("'cameras' is an object of objects, got something else")
    cameras = {}
    for number, camera in data.items():
        with naming(f"camera {number!r}"):
            cameras[number] = Camera.from_dict(camera)
    return cameras


def _frame(
    root: Path, entry: object, cameras: dict[str, Camera]
) -> tuple[Split, Frame]:
    if not isinstance(entry, dict):
        raise ValueError(f"is an object, got {entry!r}")
    camera = entry.get("camera")
    split = entry.get("split")
    image = path_inside(entry.get("image"), "'image'")
    optional: JsonObject = {}
    depth = entry.get("depth")
    if depth is not None:
        optional["depth"] = root / path_inside(depth, "'depth'")
    joints = entry.get("joints_rad")
    if joints is not None:
        optional["joints_rad"] = tuple(_numbers(joints, "joints_rad"))
    if not isinstance(camera, str) or camera not in cameras:
        raise ValueError(f"'camera' is one of {sorted(cameras)}, got {camera!r}")
    if split not in ("train", "test"):
        raise ValueError(f"'split' is 'train' or 'test', got {split!r}")
    for key in ("base_from_camera", "base_from_gripper"):
        with naming(repr(key)):
            optional[key] = _pose(entry.get(key))
    name = str(entry.get("name", image))
    return split, Frame(name, root / image, cameras[camera], **optional)


def _pose(data: Any) -> SE3 | None:
    if data is None:
        return None
    if not isinstance(data, dict):
        data = {}
    parts = []
    for key, count in (("quaternion_wxyz", 4), ("translation_m", 3)):
        parts.append(np.array(_numbers(data.get(key), key, count)))
    quaternion, translation = parts
    if not abs(np.linalg.norm(quaternion) - 1.0) < 1e-2:
        raise ValueError(f"'quaternion_wxyz' has length 1, got {quaternion}")
    return SE3(quaternion, translation)


def _numbers(value: Any, name: str, count: int | None = None) -> list[float]:
    is_list = isinstance(value, list) and count in (None, len(value))
    if not is_list or not all(map(is_real, value)):
        raise ValueError(f"'{name}' is {count or 'a list of'} numbers, got {value!r}")
    return [*map(float, value)]
