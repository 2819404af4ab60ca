"""Folders laid out as 7-Scenes and 12-Scenes are published, with images of the sample rooms.

    DIR/7scenes/chess/TrainSplit.txt, seq-01/frame-000000.color.png, .depth.png, .pose.txt
    DIR/12scenes/apt1/kitchen/info.txt, split.txt, data/frame-000000.color.jpg, ...
    DIR/pgt/sfm/7scenes/chess_train.txt, DIR/pgt/sfm/12scenes/apt1_kitchen_train.txt, ...

They have the warts of the originals: Thumbs.db, split files of Windows, poses of the depth camera
(7-Scenes), frames without a pose. Each scene is a room, mirrored or not, with its channels in
another order. Frames beyond those of a room are hard links, so the full size fits on a disk.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from evercal.geometry import SE3, Camera
from evercal.recordings import Frame, Recording, as_rgb, write_image
from evercal.recordings.formats.tracked_frames import COLOUR_FROM_DEPTH
from evercal.recordings.samples import sample_rooms

SEVEN = {
    "chess": ((1, 2, 4, 6), (3, 5), 1000),
    "fire": ((1, 2), (3, 4), 1000),
    "heads": ((2,), (1,), 1000),
    "office": ((1, 3, 4, 5, 8, 10), (2, 6, 7, 9), 1000),
    "pumpkin": ((2, 3, 6, 8), (1, 7), 1000),
    "redkitchen": ((1, 2, 5, 7, 8, 11, 13), (3, 4, 6, 12, 14), 1000),
    "stairs": ((2, 3, 5, 6), (1, 4), 500),
}
"""Training sequences, test sequences and frames of each, as published."""
TWELVE = {
    "apt1/kitchen": (744, 357),
    "apt1/living": (1035, 493),
    "apt2/bed": (890, 244),
    "apt2/kitchen": (782, 230),
    "apt2/living": (731, 359),
    "apt2/luke": (1370, 624),
    "office1/gates362": (3540, 386),
    "office1/gates381": (2950, 1053),
    "office1/lounge": (933, 327),
    "office1/manolis": (1623, 807),
    "office2/5a": (1001, 497),
    "office2/5b": (1391, 405),
}
"""Training and test frames, as listed in github.com/tsattler/visloc_pseudo_gt_limitations."""
SEVEN_CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
TWELVE_CAMERA = Camera(1296, 968, 1158.3, 1153.53, 649.0, 483.5)
_MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])
_INFO = """m_versionNumber = 4
m_sensorName = StructureSensor
m_colorWidth = 1296
m_colorHeight = 968
m_depthWidth = 640
m_depthHeight = 480
m_depthShift = 1000
m_calibrationColorIntrinsic = 1158.3 0 649 0 0 1153.53 483.5 0 0 0 1 0 0 0 0 1
m_calibrationColorExtrinsic = 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1
m_frames.size = {size}
"""


@dataclass
class FakedScene:
    """A sample room that stands for a scene of a data set."""

    room: Recording
    camera: Camera
    number: int
    """Number of the scene; the first 36 look different."""
    _first: dict[int, Path] = field(default_factory=dict)

    @property
    def is_mirrored(self) -> bool:
        """Whether left and right are exchanged."""
        return self.number // 3 % 2 == 1

    def pose(self, frame: Frame) -> np.ndarray:
        """base_from_camera of the scene's image of a frame, (4, 4)."""
        assert frame.base_from_camera is not None
        matrix = frame.base_from_camera.matrix()
        if self.is_mirrored:
            matrix = _MIRROR @ matrix @ _MIRROR
        return matrix

    def write(self, frame: Frame, path: Path) -> None:
        """Write the scene's image of a frame, or link the file that has it."""
        if id(frame) in self._first:
            path.hardlink_to(self._first[id(frame)])
            return
        self._first[id(frame)] = path
        scale = np.array([self.camera.fx, self.camera.fy]) / frame.camera.fx
        if self.is_mirrored:
            scale[0] = -scale[0]
        source = np.array([frame.camera.cx, frame.camera.cy])
        shift = np.array([self.camera.cx, self.camera.cy]) - scale * source
        affine = np.column_stack([np.diag(scale), shift])
        pixels = cv2.warpAffine(frame.read_image(), affine, self.camera.size)
        orders = list(itertools.permutations(range(3)))
        order = orders[self.number // 6 % len(orders)]
        write_image(path, as_rgb(pixels[..., order]))


def run(
    out: Path, frames: int = 20, sets: tuple[str, ...] = ("7scenes", "12scenes")
) -> int:
    """Write the folders.

    Args:
        out: New or empty folder.
        frames: Frames of a sequence, at most; 4000 for all that are published.
        sets: Which data sets.
    """
    rooms = [room.scene for room in sample_rooms()]
    writers = {
        "7scenes": (SEVEN, SEVEN_CAMERA, write_seven),
        "12scenes": (TWELVE, TWELVE_CAMERA, write_twelve),
    }
    for name in sets:
        scenes, camera, write = writers[name]
        for number, scene in enumerate(scenes):
            faked = FakedScene(rooms[number % 3], camera, number)
            write(out, scene, faked, frames)
            print(f"{out / name / scene}")
    return 0


def write_seven(out: Path, name: str, scene: FakedScene, frames: int) -> None:
    """Write a scene of 7-Scenes, and its poses by structure from motion."""
    root = out / "7scenes" / name
    train, test, published = SEVEN[name]
    count = min(frames, published)
    root.mkdir(parents=True)
    for file, split, numbers, of_room in (
        ("TrainSplit.txt", "train", train, scene.room.train),
        ("TestSplit.txt", "test", test, scene.room.test),
    ):
        lines = [f"sequence{number}\r\n" for number in numbers]
        (root / file).write_bytes("".join(lines).encode())
        source = itertools.cycle(of_room)
        listed = []
        for number in numbers:
            folder = root / f"seq-{number:02d}"
            chosen = list(itertools.islice(source, count))
            poses = [scene.pose(frame) for frame in chosen]
            stated = [pose @ COLOUR_FROM_DEPTH.matrix() for pose in poses]
            if number == train[0]:
                stated[-1] = np.full((4, 4), np.nan)
            _write_frames(folder, scene, chosen, stated, ".png")
            for i, pose in enumerate(poses):
                name_of = f"{folder.name}/frame-{i:06d}.color.png"
                listed.append(_sfm_line(name_of, pose, scene.camera))
        _write_sfm(out / "pgt/sfm/7scenes" / f"{name}_{split}.txt", listed)


def write_twelve(out: Path, name: str, scene: FakedScene, frames: int) -> None:
    """Write a scene of 12-Scenes, and its poses by structure from motion."""
    root = out / "12scenes" / name
    train, test = (min(count, frames) for count in TWELVE[name])
    chosen = list(itertools.islice(itertools.cycle(scene.room.test), test))
    chosen += itertools.islice(itertools.cycle(scene.room.train), train)
    poses = [scene.pose(frame) for frame in chosen]
    stated = poses.copy()
    stated[test] = np.full((4, 4), -np.inf)
    _write_frames(root / "data", scene, chosen, stated, ".jpg")
    (root / "info.txt").write_text(_INFO.format(size=len(chosen)))
    (root / "split.txt").write_text(
        f"sequence0 [frames={test}]  [start=0 ; end={test - 1}]\n"
        f"sequence1 [frames={train}]  [start={test} ; end={len(chosen) - 1}]\n"
    )
    lines = []
    for i, pose in enumerate(poses):
        lines.append(_sfm_line(f"data/frame-{i:06d}.color.jpg", pose, scene.camera))
    stem = name.replace("/", "_")
    folder = out / "pgt/sfm/12scenes"
    _write_sfm(folder / f"{stem}_test.txt", lines[:test])
    _write_sfm(folder / f"{stem}_train.txt", lines[test:])


def _write_frames(
    folder: Path,
    scene: FakedScene,
    frames: Sequence[Frame],
    stated: Sequence[np.ndarray],
    ending: str,
) -> None:
    folder.mkdir(parents=True)
    (folder / "Thumbs.db").write_bytes(b"\xd0\xcf\x11\xe0")
    depth = folder.parent / "depth.png"
    if not depth.exists():
        cv2.imwrite(str(depth), np.full((480, 640), 2000, np.uint16))
    for i, (frame, matrix) in enumerate(zip(frames, stated, strict=True)):
        stem = folder / f"frame-{i:06d}"
        scene.write(frame, stem.with_suffix(f".color{ending}"))
        stem.with_suffix(".depth.png").hardlink_to(depth)
        stem.with_suffix(".pose.txt").write_bytes(_matrix_text(matrix).encode())
    depth.unlink()


def _matrix_text(matrix: np.ndarray) -> str:
    """Four lines as printed by programs of Windows."""
    lines = []
    for row in matrix.tolist():
        lines.append("\t ".join(map("{: .7e}".format, row)) + "\t \r\n")
    return "".join(lines).replace("-inf", "-1.#INF").replace("nan", "-1.#IND")


def _sfm_line(name: str, pose: np.ndarray, camera: Camera) -> str:
    inverse = SE3.from_matrix(pose).inverse()
    numbers = [*inverse.rotation_wxyz.tolist(), *inverse.translation_m.tolist()]
    return " ".join([name, *map("{:.7f}".format, numbers), f"{camera.fx}"])


def _write_sfm(file: Path, lines: Sequence[str]) -> None:
    """All frames but the last, which counts as not reconstructed."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("\n".join(lines[:-1]) + "\n")
