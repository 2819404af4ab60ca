"""evercal's own folder format: one `scene.json` beside the images it names.

    {"format": "evercal-scene", "version": 1, "name": "kitchen",
     "cameras": {"0": {"width", "height", "fx", "fy", "cx", "cy", "distortion": []}},
     "frames": [{"name": "000000", "image": "images/000000.png", "camera": "0", "split": "train",
                 "base_from_camera": {"translation_m": [3], "quaternion_wxyz": [4]},
                 "base_from_gripper": null, "depth": "depth/000000.png",
                 "joints_rad": [7]}, ...],
     "untracked": 0, "notes": [], "render": {}}

Metres, quaternions in the order w, x, y, z, OpenCV camera axes, pixel (0, 0) at the centre of the
top-left pixel, distortion k1 k2 p1 p2 k3 k4 k5 k6 as in OpenCV. Image paths are relative to the
folder, with forward slashes. Both poses may be null or missing, as may `name` and `untracked`.
Depth is a 16-bit PNG in millimetres along the optical axis, 0 where unknown; it and the arm's joint
angles are there only if known. `notes` are sentences about how the recording was read. `render`
tells how a simulated scene was made.
Frames stand in the order they were recorded. Keys not listed here are passed over.
"""

import json
import os
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path, PurePosixPath
from types import TracebackType
from typing import Any, Literal, Self

from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings.frame import Frame, Recording
from evercal.recordings.images import StoredImage, write_image
from evercal.storage import write_json

FILE = "scene.json"
_FORMAT = "evercal-scene"
_VERSION = 1
_BEGUN = ".unfinished"
"""Lies in a folder while it is written, and stays when the writer is cut off."""


def detect(root: Path) -> bool:
    """Whether `root` holds a scene.json."""
    return (root / FILE).is_file()


def load(root: str | os.PathLike[str]) -> Recording:
    """Reads scene.json and checks that every image it names is there; opens none of them.

    Raises:
        InputError: scene.json or an image is missing, or scene.json breaks the format; the message
            names the file and the entry.
    """
    root = Path(root)
    file = root / FILE
    data = _read(file)
    try:
        cameras = _cameras(data.get("cameras"))
        entries = data.get("frames")
        if not isinstance(entries, list):
            raise ValueError("'frames' is a list, got something else")
        frames: dict[str, list[Frame]] = {"train": [], "test": []}
        for i, entry in enumerate(entries):
            split, frame = _frame(root, i, entry, cameras)
            frames[split].append(frame)
        untracked = data.get("untracked", 0)
        if not isinstance(untracked, int):
            raise ValueError(f"'untracked' is a count, got {untracked!r}")
        _refuse_repeated_names(frames["train"] + frames["test"])
    except (ValueError, OverflowError) as error:  # JSON numbers have no largest
        raise InputError(f"{file}: {error}") from None
    if not entries:
        raise InputError(f"{file}: no frames; a scene has at least one")
    _refuse_missing_images(root, frames["train"] + frames["test"])
    name = data.get("name")
    return Recording(
        name if isinstance(name, str) and name else root.resolve().name,
        tuple(frames["train"]),
        tuple(frames["test"]),
        untracked,
        notes=_notes(file, data.get("notes", [])),
    )


def write(
    root: str | os.PathLike[str],
    scene: Recording,
    *,
    link: bool = False,
    on_frame: Callable[[], object] | None = None,
) -> None:
    """Writes a scene with its images; images that are files are copied byte for byte.

    Args:
        root: Folder to write to; made when missing.
        scene: What to write.
        link: Whether image files are hard links where the disk allows them, which take no room.
        on_frame: Called after every frame, for progress bars.

    Raises:
        InputError: `root` already holds a scene, or an image cannot be read.
    """
    with SceneWriter(root, scene.name, link) as writer:
        writer.untracked, writer.notes = scene.untracked, scene.notes
        for i, frame in enumerate((*scene.train, *scene.test)):
            writer.add(frame, "train" if i < len(scene.train) else "test")
            if on_frame is not None:
                on_frame()


class SceneWriter:
    """Writes frames one by one; scene.json comes last, when the `with` block ends without error.

    A folder without scene.json is therefore a recording that was cut off, not a short scene.

    Args:
        root: Folder to write to; made when missing.
        name: What the scene is called.
        link: Whether image files are hard links where the disk allows them.

    Raises:
        InputError: `root` already holds a scene; and from `add`, an image that is none of ours.
    """

    def __init__(self, root: str | os.PathLike[str], name: str, link: bool = False) -> None:
        self.untracked = 0
        self.notes: tuple[str, ...] = ()
        self.render: dict[str, object] | None = None
        self._root = Path(root)
        self._name = name
        self._link = link
        self._cameras: dict[Camera, str] = {}
        self._frames: list[dict[str, object]] = []
        self._names: set[str] = set()
        if (self._root / FILE).exists():
            raise InputError(
                f"{self._root / FILE}: already there; give a new folder, or remove the whole folder"
            )
        (self._root / "images").mkdir(parents=True, exist_ok=True)
        self._begun = self._root / _BEGUN
        self._goes_on = self._begun.exists()

    def __enter__(self) -> Self:
        """Nothing to open: the folder was made with the writer."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Writes scene.json unless something went wrong."""
        if kind is None:
            self.close()

    def add(self, frame: Frame, split: Literal["train", "test"]) -> None:
        """Writes the frame's image and remembers the rest.

        Raises:
            InputError: The frame's image cannot be read, or its name was used before.
        """
        if frame.name in self._names:
            raise InputError(f"frame {frame.name!r}: already written; frame names are unique")
        # The counter keeps names like 'a/b' and 'a_b' apart and the folder in recorded order.
        stem = f"{len(self._frames):06d}"
        relative = self._write_image(frame, f"images/{stem}")
        self._names.add(frame.name)
        entry: dict[str, object] = {
            "name": frame.name,
            "image": relative,
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
        self._frames.append(entry)

    def _write_image(self, frame: Frame, stem: str) -> str:
        """Writes an image as it is stored, else as a PNG, and gives its path in the folder."""
        if isinstance(frame.image, Path):
            relative = stem + frame.image.suffix.lower()
            self._copy(frame.image, relative)
            return relative
        stored = frame.image.file() if isinstance(frame.image, StoredImage) else None
        if stored is None:
            image = frame.read_image()
            self._put(f"{stem}.png", lambda path: write_image(path, image))
            return f"{stem}.png"
        ending, content = stored
        self._put(f"{stem}{ending}", lambda path: path.write_bytes(content))
        return f"{stem}{ending}"

    def _copy(self, source: Path, relative: str) -> None:
        """Copies or links a file to its place; one that already lies there stays as it is."""
        target = self._root / relative
        if target.exists() and target.samefile(source):
            return
        try:
            # A link through a link would point to nothing once the folder moves.
            self._put(
                relative,
                lambda path: (
                    (self._link and self._linked(source.resolve(), path))
                    or shutil.copyfile(source, path)
                ),
            )
        except OSError as error:
            raise InputError(f"{source}: cannot be copied ({error.strerror})") from None

    def _put(self, relative: str, write: Callable[[Path], object]) -> None:
        """Writes a file beside its place and moves it there, so no hard link is written through.

        Raises:
            InputError: A file lies there that is not left from a recording that was cut off.
        """
        target = self._root / relative
        if target.exists() and not self._goes_on:
            self._begun.unlink(missing_ok=True)
            raise InputError(f"{target}: already there; give a new folder")
        self._begun.touch()
        beside = target.with_name(f".{target.name}")
        beside.unlink(missing_ok=True)
        write(beside)
        beside.replace(target)

    @staticmethod
    def _linked(source: Path, target: Path) -> bool:
        """Whether a hard link could be made; not from one disk to another."""
        try:
            target.hardlink_to(source)
        except OSError:
            return False
        return True

    def close(self) -> None:
        """Writes scene.json."""
        data: dict[str, object] = {
            "format": _FORMAT,
            "version": _VERSION,
            "name": self._name,
            "cameras": {number: camera.to_dict() for camera, number in self._cameras.items()},
            "frames": self._frames,
            "untracked": self.untracked,
        }
        if self.notes:
            data["notes"] = list(self.notes)
        if self.render is not None:
            data["render"] = self.render
        write_json(self._root / FILE, data)
        self._begun.unlink(missing_ok=True)


def pose_to_dict(pose: SE3 | None) -> dict[str, object] | None:
    """A single transform as plain numbers, metres and wxyz; None stays None."""
    if pose is None:
        return None
    return {
        "translation_m": pose.translation_m.tolist(),
        "quaternion_wxyz": pose.rotation_wxyz.tolist(),
    }


def pose_from_dict(data: object) -> SE3 | None:
    """The inverse of `pose_to_dict`.

    Raises:
        ValueError: Not three and four finite numbers, or a quaternion that is not of length one.
    """
    if data is None:
        return None
    if not isinstance(data, Mapping):
        raise ValueError(f"is {{'translation_m', 'quaternion_wxyz'}} or null, got {data!r}")
    translation = _numbers(data.get("translation_m"), 3, "translation_m")
    quaternion = _numbers(data.get("quaternion_wxyz"), 4, "quaternion_wxyz")
    length = sum(value * value for value in quaternion) ** 0.5
    if not abs(length - 1.0) < 1e-2:
        raise ValueError(f"'quaternion_wxyz' has length 1, got {quaternion}")
    return SE3(quaternion, translation)  # pyright: ignore[reportArgumentType]


def _read(file: Path) -> dict[str, object]:
    try:
        data = json.loads(file.read_bytes())
    except OSError:
        raise InputError(f"{file}: missing; a scene folder of this format holds one") from None
    except ValueError as error:
        raise InputError(f"{file}: not valid JSON ({error}); write it anew") from None
    if not isinstance(data, dict) or data.get("format") != _FORMAT:
        raise InputError(f"{file}: 'format' is not '{_FORMAT}'; this is another program's file")
    if data.get("version") != _VERSION:
        raise InputError(
            f"{file}: version {data.get('version')!r}, this evercal reads {_VERSION}; update"
            f" evercal or convert the scene"
        )
    return data


def _cameras(data: object) -> dict[str, Camera]:
    if not isinstance(data, dict):
        raise ValueError("'cameras' is an object of cameras, got something else")
    cameras = {}
    for number, camera in data.items():
        if not isinstance(camera, dict):
            raise ValueError(f"camera {number!r} is an object, got {camera!r}")
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
    image = _inside(entry.get("image"), f"frame {i}: 'image'")
    depth = entry.get("depth")
    poses: dict[str, Any] = {}
    if depth is not None:
        poses["depth"] = root / _inside(depth, f"frame {i}: 'depth'")
    if (joints := entry.get("joints_rad")) is not None:
        count = len(joints) if isinstance(joints, list) else 7
        poses["joints_rad"] = tuple(_numbers(joints, count, f"frame {i}: joints_rad"))
    if not isinstance(camera, str) or camera not in cameras:
        raise ValueError(f"frame {i}: 'camera' is one of {sorted(cameras)}, got {camera!r}")
    if split not in ("train", "test"):
        raise ValueError(f"frame {i}: 'split' is 'train' or 'test', got {split!r}")
    for key in ("base_from_camera", "base_from_gripper"):
        try:
            poses[key] = pose_from_dict(entry.get(key))
        except ValueError as error:
            raise ValueError(f"frame {i}: '{key}': {error}") from None
    name = entry.get("name", image)
    return split, Frame(str(name), root / image, cameras[camera], **poses)


def _notes(file: Path, notes: object) -> tuple[str, ...]:
    if not isinstance(notes, list) or not all(isinstance(note, str) for note in notes):
        raise InputError(f"{file}: 'notes' is a list of sentences, got {notes!r}")
    return tuple(notes)


def _inside(path: object, what: str) -> str:
    if not isinstance(path, str) or not path or PurePosixPath(path).is_absolute():
        raise ValueError(f"{what} is a path relative to the folder, got {path!r}")
    if ".." in PurePosixPath(path).parts:
        raise ValueError(f"{what} stays inside the folder, got {path!r}")
    return path


def _numbers(value: object, count: int, name: str) -> list[float]:
    plain = isinstance(value, list) and all(
        isinstance(v, (int, float)) and not isinstance(v, bool) for v in value
    )
    if not isinstance(value, list) or not plain or len(value) != count:
        raise ValueError(f"'{name}' is {count} numbers, got {value!r}")
    return [float(v) for v in value]


def _refuse_repeated_names(frames: list[Frame]) -> None:
    seen: set[str] = set()
    for frame in frames:
        if frame.name in seen:
            raise ValueError(f"frame name {frame.name!r} comes twice; names are unique")
        seen.add(frame.name)


def _refuse_missing_images(root: Path, frames: list[Frame]) -> None:
    missing = [frame.image for frame in frames if not Path(frame.image).is_file()]  # pyright: ignore[reportArgumentType]
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise InputError(
            f"{missing[0]}{more}: named in {root / FILE} but missing; restore or take the frame out"
        )
