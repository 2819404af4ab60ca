"""evercal's own folder format: one `scene.json` beside the images it names.

docs/formats.md lists the keys. `render` describes how a simulated scene was made. Unknown keys are
ignored.
"""

import contextlib
import os
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path, PureWindowsPath
from typing import Any, Literal, Self

import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3, Camera, pose_to_dict
from evercal.recordings.frame import Frame, Recording
from evercal.recordings.images import StoredImage, write_image
from evercal.recordings.text_files import first_repeated, named_errors, read_json
from evercal.storage import write_json

FILE = "scene.json"
_FORMAT = "evercal-scene"
_VERSION = 1
_UNFINISHED = ".unfinished"
"""Marker file in a folder that is being written; it stays if the writer is interrupted."""


def detect(root: Path) -> bool:
    """Whether `root` holds a scene.json."""
    return (root / FILE).is_file()


def load(root: str | os.PathLike[str]) -> Recording:
    """Read scene.json and check that its images exist; no image is opened."""
    root = Path(root)
    file = root / FILE
    data = _read(file)
    with named_errors(file, "scene file"):
        cameras = _cameras(data.get("cameras"))
        entries = data.get("frames")
        if not isinstance(entries, list) or not entries:
            raise ValueError("'frames' is a list with at least one frame")
        frames = [_frame(root, i, entry, cameras) for i, entry in enumerate(entries)]
        untracked = data.get("untracked", 0)
        if not isinstance(untracked, int):
            raise ValueError(f"'untracked' is a count, got {untracked!r}")
        unit = data.get("unit", "metres")
        if unit not in ("metres", "unknown"):
            raise ValueError(f"'unit' is 'metres' or 'unknown', got {unit!r}")
        notes = data.get("notes", [])
        if not isinstance(notes, list) or not all(isinstance(note, str) for note in notes):
            raise ValueError(f"'notes' is a list of sentences, got {notes!r}")
        repeated = first_repeated([frame.name for _, frame in frames])
        if repeated is not None:
            raise ValueError(f"frame name {repeated!r} comes twice; names are unique")
    images = [Path(str(frame.image)) for _, frame in frames]
    missing = [image for image in images if not image.is_file()]
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise InputError(
            f"{missing[0]}{more}: named in {file} but missing; restore or take the frame out"
        )
    name = data.get("name")
    train, test = (tuple(f for s, f in frames if s == split) for split in ("train", "test"))
    return Recording(
        name if isinstance(name, str) and name else root.resolve().name,
        train,
        test,
        untracked,
        notes=tuple(notes),
        metric=unit == "metres",
    )


def write(
    root: str | os.PathLike[str],
    recording: Recording,
    *,
    link: bool = False,
    on_frame: Callable[[], object] | None = None,
) -> None:
    """Write a recording with its images; image files are copied byte for byte.

    Args:
        root: Folder to write to; created if missing.
        recording: Frames to write.
        link: Create hard links to image files where the file system allows it.
        on_frame: Called after every frame, for progress bars.

    Raises:
        InputError: `root` already holds a scene, or an image cannot be read.
    """
    with SceneWriter(root, recording.name, link) as writer:
        writer.untracked, writer.notes = recording.untracked, recording.notes
        writer.metric = recording.metric
        for i, frame in enumerate((*recording.train, *recording.test)):
            writer.add(frame, "train" if i < len(recording.train) else "test")
            if on_frame is not None:
                on_frame()


class SceneWriter:
    """Write frames one by one; scene.json is written last, if the `with` block ends without error.

    A folder without scene.json is therefore an interrupted recording, not a short scene. Arguments
    and errors are those of `write`.
    """

    def __init__(self, root: str | os.PathLike[str], name: str, link: bool = False) -> None:
        self.untracked = 0
        self.notes: tuple[str, ...] = ()
        self.metric = True
        self.render: dict[str, object] | None = None
        self._root = Path(root)
        self._name = name
        self._link = link
        self._cameras: dict[Camera, str] = {}
        self._entries: dict[str, dict[str, object]] = {}
        if (self._root / FILE).exists():
            raise InputError(
                f"{self._root / FILE}: already there; give a new folder, or remove the whole folder"
            )
        (self._root / "images").mkdir(parents=True, exist_ok=True)
        self._resumed = (self._root / _UNFINISHED).exists()

    def __enter__(self) -> Self:
        """Return the writer; its folder exists already."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Write scene.json unless an error was raised."""
        if kind is not None:
            return
        data: dict[str, object] = {
            "format": _FORMAT,
            "version": _VERSION,
            "name": self._name,
            "cameras": {number: camera.to_dict() for camera, number in self._cameras.items()},
            "frames": list(self._entries.values()),
            "untracked": self.untracked,
        }
        data |= {} if self.metric else {"unit": "unknown"}
        data |= {"notes": list(self.notes)} if self.notes else {}
        data |= {"render": self.render} if self.render is not None else {}
        try:
            write_json(self._root / FILE, data)
            (self._root / _UNFINISHED).unlink(missing_ok=True)
        except OSError as error:
            raise InputError(f"{self._root / FILE}: cannot be written ({error.strerror})") from None

    def add(self, frame: Frame, split: Literal["train", "test"]) -> None:
        """Write the frame's image and collect its entry of scene.json."""
        if frame.name in self._entries:
            raise InputError(f"frame {frame.name!r}: already written; frame names are unique")
        # The counter keeps names like 'a/b' and 'a_b' apart and the folder in recorded order.
        stem = f"{len(self._entries):06d}"
        entry: dict[str, object] = {
            "name": frame.name,
            "image": self._write_image(frame, f"images/{stem}"),
            "camera": self._cameras.setdefault(frame.camera, str(len(self._cameras))),
            "split": split,
            "base_from_camera": pose_to_dict(frame.base_from_camera),
            "base_from_gripper": pose_to_dict(frame.base_from_gripper),
        }
        if frame.depth is not None:
            entry["depth"] = f"depth/{stem}.png"
            (self._root / "depth").mkdir(exist_ok=True)
            self._copy(frame.depth, f"depth/{stem}.png")
        if frame.joints_rad is not None:
            entry["joints_rad"] = list(frame.joints_rad)
        self._entries[frame.name] = entry

    def _write_image(self, frame: Frame, stem: str) -> str:
        """Write an image file as it is stored, else a PNG; return its path in the folder."""
        if isinstance(frame.image, Path):
            relative = stem + frame.image.suffix.lower()
            self._copy(frame.image, relative)
            return relative
        stored = frame.image.file() if isinstance(frame.image, StoredImage) else None
        if stored is None:
            relative, image = f"{stem}.png", frame.read_image()
            self._put(relative, lambda path: write_image(path, image))
        else:
            relative = stem + stored[0]
            self._put(relative, lambda path: path.write_bytes(stored[1]))
        return relative

    def _copy(self, source: Path, relative: str) -> None:
        """Copy or link a file into the folder, unless it is that file already."""
        target = self._root / relative
        if target.exists() and target.samefile(source):
            return

        def write(path: Path) -> None:
            if self._link:
                with contextlib.suppress(OSError):  # not every file system has links
                    # A link through a link would be broken once the folder moves.
                    return path.hardlink_to(source.resolve())
            shutil.copyfile(source, path)

        try:
            source.stat()
        except OSError as error:
            raise InputError(f"{source}: cannot be copied ({error.strerror})") from None
        self._put(relative, write)

    def _put(self, relative: str, write: Callable[[Path], object]) -> None:
        """Write a file under a temporary name and move it, so no hard link is written through."""
        target, marker = self._root / relative, self._root / _UNFINISHED
        if target.exists() and not self._resumed:
            marker.unlink(missing_ok=True)
            raise InputError(f"{target}: already there; give a new folder")
        temporary = target.with_name(f".{target.name}")
        try:
            marker.touch()
            temporary.unlink(missing_ok=True)
            write(temporary)
            temporary.replace(target)
        except OSError as error:
            raise InputError(f"{target}: cannot be written ({error.strerror})") from None


def _pose_from_dict(data: object) -> SE3 | None:
    if data is None:
        return None
    if not isinstance(data, Mapping):
        raise ValueError(f"is {{'translation_m', 'quaternion_wxyz'}} or null, got {data!r}")
    translation = np.array(_numbers(data.get("translation_m"), 3, "translation_m"))
    quaternion = np.array(_numbers(data.get("quaternion_wxyz"), 4, "quaternion_wxyz"))
    if not abs(np.linalg.norm(quaternion) - 1.0) < 1e-2:
        raise ValueError(f"'quaternion_wxyz' has length 1, got {quaternion}")
    return SE3(quaternion, translation)


def _read(file: Path) -> dict[str, object]:
    data = read_json(file, "scene file", "convert the recording again")
    if data.get("format") != _FORMAT:
        raise InputError(f"{file}: 'format' is not '{_FORMAT}'; this is another program's file")
    if data.get("version") != _VERSION:
        raise InputError(
            f"{file}: version {data.get('version')!r}, this evercal reads {_VERSION}; update"
            f" evercal or convert the scene"
        )
    return data


def _cameras(data: object) -> dict[str, Camera]:
    if not isinstance(data, dict) or not all(isinstance(c, dict) for c in data.values()):
        raise ValueError("'cameras' is an object of objects, got something else")
    cameras = {}
    for number, camera in data.items():
        try:
            cameras[number] = Camera.from_dict(camera)
        except ValueError as error:
            raise ValueError(f"camera {number!r}: {error}") from None
    return cameras


def _frame(
    root: Path, i: int, entry: object, cameras: dict[str, Camera]
) -> tuple[Literal["train", "test"], Frame]:
    if not isinstance(entry, dict):
        raise ValueError(f"frame {i} is an object, got {entry!r}")
    camera, split = entry.get("camera"), entry.get("split")
    image = path_inside(entry.get("image"), f"frame {i}: 'image'")
    optional: dict[str, Any] = {}
    if (depth := entry.get("depth")) is not None:
        optional["depth"] = root / path_inside(depth, f"frame {i}: 'depth'")
    if (joints := entry.get("joints_rad")) is not None:
        count = len(joints) if isinstance(joints, list) else 7
        optional["joints_rad"] = tuple(_numbers(joints, count, f"frame {i}: joints_rad"))
    if not isinstance(camera, str) or camera not in cameras:
        raise ValueError(f"frame {i}: 'camera' is one of {sorted(cameras)}, got {camera!r}")
    if split not in ("train", "test"):
        raise ValueError(f"frame {i}: 'split' is 'train' or 'test', got {split!r}")
    for key in ("base_from_camera", "base_from_gripper"):
        try:
            optional[key] = _pose_from_dict(entry.get(key))
        except ValueError as error:
            raise ValueError(f"frame {i}: '{key}': {error}") from None
    return split, Frame(str(entry.get("name", image)), root / image, cameras[camera], **optional)


def path_inside(path: object, what: str) -> str:
    """Check that a path of a file with forward slashes stays inside the file's folder.

    Symbolic links are followed: download caches keep files elsewhere. `what` names the entry.

    Raises:
        ValueError: The path is empty, absolute or contains "..".
    """
    # Windows paths split at both kinds of slashes and have an anchor for drives as well.
    if not isinstance(path, str) or not path or PureWindowsPath(path).anchor:
        raise ValueError(f"{what} is a path relative to the folder, got {path!r}")
    if ".." in PureWindowsPath(path).parts:
        raise ValueError(f"{what} stays inside the folder, got {path!r}")
    return path


def _numbers(value: object, count: int, name: str) -> list[float]:
    if (
        not isinstance(value, list)
        or len(value) != count
        or any(isinstance(v, bool) or not isinstance(v, (int, float)) for v in value)
    ):
        raise ValueError(f"'{name}' is {count} numbers, got {value!r}")
    return [float(v) for v in value]
