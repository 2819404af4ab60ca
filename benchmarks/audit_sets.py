"""Data sets of an arm before two fixed cameras, in which some episodes state wrong camera poses.

Episodes share a few clips.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.audit_cells import CLIPS, FPS, STEPS, Cell, Options, write_video
from evercal.geometry import SE3, Camera
from evercal.recordings.poses.conventions import numbers_from_poses, pose_convention
from evercal.robot.link_shapes import robot_body
from evercal.robot.robot_model import RobotModel
from evercal.storage import write_bytes, write_json

CELLS = 5
CAMERAS = ("exterior_1_left", "exterior_2_left")
JOINTS = tuple(f"panda_joint{i}" for i in range(1, 8))
KINDS = {
    "moved": "moved since",
    "inverse": "inverse",
    "other camera": "that of",
    "gripper": "relative to",
    "Euler order": "written as moving_xyz",
    "degrees": "other unit of angles",
    "millimetres": "other unit of length",
}
"""Mistakes, and how the audit begins to name them. Degrees and order count as one kind."""
RUN = 10
"""Episodes with each mistake."""


@dataclass(frozen=True)
class Planned:
    """What an episode shows and states."""

    number: int
    cell: int
    clip: int
    mistake: str
    """A key of `KINDS`, or empty."""


def plan(options: Options) -> list[Planned]:
    """Episodes: a run that begins with a moved camera, the other mistakes at random."""
    rng = np.random.default_rng([options.seed, 77])
    mistakes = [""] * options.episodes
    start = int(0.4 * options.episodes)
    run = max(1, RUN * options.episodes // 300)
    mistakes[start : start + run] = ["moved"] * run
    counts = {"degrees": run // 2, "Euler order": run - run // 2}
    for kind in ("inverse", "other camera", "gripper", "millimetres"):
        counts[kind] = run
    free = rng.permutation([i for i in range(options.episodes) if not mistakes[i]])
    for kind, count in counts.items():
        for i in free[:count]:
            mistakes[i] = kind
        free = free[count:]
    share = -(-options.episodes // CELLS)
    return [
        Planned(i, i // share, int(rng.integers(CLIPS)), mistake)
        for i, mistake in enumerate(mistakes)
    ]


def stated(cell: Cell, episode: Planned, view: int, hand_at_start: SE3) -> np.ndarray:
    """Six numbers that an episode states."""
    pose = cell.places[view]
    convention = pose_convention("rpy")
    if episode.mistake == "inverse":
        pose = pose.inverse()
    elif episode.mistake == "other camera":
        pose = cell.places[1 - view]
    elif episode.mistake == "gripper":
        pose = hand_at_start.inverse() @ pose
    elif episode.mistake in ("degrees", "millimetres", "Euler order"):
        name = {"degrees": "rpy:deg", "millimetres": "rpy:mm"}
        convention = pose_convention(name.get(episode.mistake, "moving_xyz"))
    return numbers_from_poses(pose, convention)


def truth(cell: Cell, episode: Planned, view: int) -> SE3:
    """base_from_camera."""
    places = cell.moved if episode.mistake == "moved" else cell.places
    return places[view]


@dataclass(frozen=True, eq=False)
class Made:
    """An episode, as it is written."""

    planned: Planned
    cell: Cell
    joints: np.ndarray
    """(STEPS, 7)."""
    stated: list[np.ndarray]
    """Six numbers of each camera."""
    clips: list[list[np.ndarray]]
    """Images of each camera."""


def made(options: Options, urdf: Path) -> Iterator[Made]:
    """All episodes in order; the clips of one cell at a time are in memory."""
    model = RobotModel(urdf)
    hand = model.arm(model.base_link, "panda_hand")
    body = robot_body(model, JOINTS)
    cell: Cell | None = None
    number = -1
    drawn: dict[tuple[int, int, bool], list[np.ndarray]] = {}
    for planned in plan(options):
        if cell is None or planned.cell != number:
            number = planned.cell
            cell = Cell(number, options, body)
            drawn.clear()
        moved = planned.mistake == "moved"
        joints = cell.clips[planned.clip]
        start = hand.poses(joints[:1])[0]
        clips = []
        for view in range(len(CAMERAS)):
            what = (view, planned.clip, moved)
            if what not in drawn:
                steps = range(STEPS)
                images = [cell.image(view, moved, planned.clip, i) for i in steps]
                drawn[what] = images
            clips.append(drawn[what])
        poses = [stated(cell, planned, view, start) for view in range(len(CAMERAS))]
        yield Made(planned, cell, joints, poses, clips)


def _truth(item: Made, view: int) -> dict[str, Any]:
    pose = truth(item.cell, item.planned, view).matrix().tolist()
    return {"mistake": item.planned.mistake, "base_from_camera": pose}


def _finish(folder: Path, camera: Camera, truths: dict[str, Any]) -> None:
    """Write the intrinsics; what is wrong, and the true poses; last."""
    names = ("width", "height", "fx", "fy", "cx", "cy")
    write_json(folder / "camera.json", {name: getattr(camera, name) for name in names})
    write_json(folder / "truth.json", truths)


class _LeRobot:
    """A data set of LeRobot 3.0 with a data file and videos for each cell."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.rows: dict[str, list[Any]] = {}
        self.images: dict[str, list[np.ndarray]] = {key: [] for key in CAMERAS}
        self.episodes: list[dict[str, Any]] = []

    def add(self, item: Made) -> None:
        """Add an episode."""
        number = item.planned.number
        entry: dict[str, Any] = {"episode_index": number}
        for camera, clip in zip(CAMERAS, item.clips, strict=True):
            images = self.images[camera]
            prefix = f"videos/observation.images.{camera}"
            entry[f"{prefix}/chunk_index"] = 0
            entry[f"{prefix}/file_index"] = item.planned.cell
            entry[f"{prefix}/from_timestamp"] = len(images) / FPS
            images += clip
        self.episodes.append(entry)
        for i, joints in enumerate(item.joints):
            values: dict[str, Any] = {"episode_index": number, "frame_index": i}
            values["timestamp"] = i / FPS
            values["observation.state"] = [*joints.tolist(), 0.5]
            for camera, pose in zip(CAMERAS, item.stated, strict=True):
                values[f"camera_extrinsics.{camera}"] = pose.tolist()
            for name, value in values.items():
                self.rows.setdefault(name, []).append(value)

    def flush(self, cell: int) -> None:
        """Write the episodes of a cell."""
        name = f"chunk-000/file-{cell:03d}"
        _write_table(self.folder / f"data/{name}.parquet", self.rows)
        for camera, images in self.images.items():
            video = self.folder / f"videos/observation.images.{camera}/{name}.mp4"
            write_video(video, images)
            images.clear()
        self.rows.clear()

    def close(self, camera: Camera) -> None:
        """Write what describes the data set."""
        rows: dict[str, list[Any]] = {}
        for entry in self.episodes:
            for name, value in entry.items():
                rows.setdefault(name, []).append(value)
        _write_table(self.folder / "meta/episodes/chunk-000/file-000.parquet", rows)
        names = {"axes": [*(f"joint_{i}" for i in range(7)), "gripper"]}
        features: dict[str, Any] = {
            "observation.state": {"dtype": "float32", "names": names}
        }
        shape = [camera.height, camera.width, 3]
        for key in CAMERAS:
            picture = {"dtype": "video", "shape": shape}
            features[f"observation.images.{key}"] = picture
            features[f"camera_extrinsics.{key}"] = {"dtype": "float32", "shape": [6]}
        video = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
        info = {"codebase_version": "v3.0", "fps": FPS, "video_path": video}
        info |= {"total_episodes": len(self.episodes), "features": features}
        write_json(self.folder / "meta/info.json", info)


def _write_table(path: Path, rows: dict[str, list[Any]]) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table(rows), path)


def write_lerobot(options: Options, urdf: Path, folder: Path) -> None:
    """Write a data set of LeRobot 3.0, as DROID's port."""
    writer = _LeRobot(folder)
    truths: dict[str, Any] = {}
    last: Made | None = None
    for item in made(options, urdf):
        if last is not None and last.planned.cell != item.planned.cell:
            writer.flush(last.planned.cell)
        last = item
        writer.add(item)
        for view, camera in enumerate(CAMERAS):
            key = f"episode_{item.planned.number:06d} camera_extrinsics.{camera}"
            truths[key] = _truth(item, view)
    assert last is not None, "there are episodes"
    writer.flush(last.planned.cell)
    writer.close(last.cell.camera)
    _finish(folder.parent, last.cell.camera, truths)


def write_droid(options: Options, urdf: Path, folder: Path) -> None:
    """Write folders in DROID's layout."""
    import h5py  # pyright: ignore[reportMissingImports]

    truths: dict[str, Any] = {}
    camera: Camera | None = None
    for item in made(options, urdf):
        camera = item.cell.camera
        number = item.planned.number
        stamp = f"2023-07-08-00h-{number // 60:02d}m-{number % 60:02d}s"
        name = f"LAB{item.planned.cell}+0123abcd+{stamp}"
        root = folder / f"LAB{item.planned.cell}/success/2023-07-08/{number:06d}"
        metadata: dict[str, Any] = {"uuid": name}
        for view, clip in enumerate(item.clips):
            serial = f"{20000000 + 10 * item.planned.cell + view}"
            metadata[f"ext{view + 1}_cam_serial"] = serial
            metadata[f"ext{view + 1}_cam_extrinsics"] = item.stated[view].tolist()
            moved = item.planned.mistake == "moved"
            shown = f"{item.planned.cell}-{item.planned.clip}-{view}-{moved:d}.mp4"
            source = folder.parent / "clips" / shown
            if not source.exists():
                write_video(source, clip)
            video = root / "recordings/MP4" / f"{serial}.mp4"
            video.parent.mkdir(parents=True, exist_ok=True)
            video.hardlink_to(source)
            truths[f"{name} {serial}"] = _truth(item, view)
        with h5py.File(root / "trajectory.h5", "w") as file:
            file["observation/robot_state/joint_positions"] = item.joints
        write_bytes(root / f"metadata_{name}.json", json.dumps(metadata).encode())
    assert camera is not None, "there are episodes"
    _finish(folder.parent, camera, truths)
