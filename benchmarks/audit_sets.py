"""Data sets of an arm before two fixed cameras, in which some episodes state wrong camera poses.

Episodes share a few clips. Their images are drawn by OpenCV before a painted room, with noise of
the sensor and video compression.
"""

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from evercal.geometry import SE3, Camera
from evercal.recordings.poses.conventions import numbers_from_poses, pose_convention
from evercal.robot.link_shapes import RobotBody, robot_body
from evercal.robot.robot_model import RobotModel
from evercal.simulation.box_room import look_at
from evercal.storage import write_bytes, write_json

CELLS = 5
CLIPS = 3
"""Motions in each cell."""
STEPS = 36
"""Images of a clip."""
FPS = 15
CAMERAS = ("exterior_1_left", "exterior_2_left")
JOINTS = tuple(f"panda_joint{i}" for i in range(1, 8))
LOW = np.array([-1.2, -0.6, -0.8, -2.6, -1.2, 1.0, -1.5])
HIGH = np.array([1.2, 0.9, 0.8, -1.2, 1.2, 2.8, 1.5])
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
class Options:
    """Size of a data set."""

    episodes: int = 300
    width: int = 320
    """Of the images, pixels; the height is 9/16 of it."""
    seed: int = 0


class Cell:
    """Two cameras, a painted room, and motions of the arm."""

    def __init__(self, number: int, options: Options, body: RobotBody) -> None:
        self.rng = np.random.default_rng([options.seed, number])
        width = options.width
        focal = 0.42 * width
        height = width * 9 // 16
        centre = ((width - 1) / 2, (height - 1) / 2)
        self.camera = Camera(width, height, focal, focal, *centre)
        self.body = body
        self.places = [self._place(side) for side in (1, -1)]
        self.moved = [place @ _bump(self.rng) for place in self.places]
        self.clips = [self._motion() for _ in range(CLIPS)]
        self._walls = [_painted(self.rng, 2 * width, 2 * height) for _ in range(4)]
        self._light = self.rng.normal((0, 0, 2))

    def _place(self, side: int) -> SE3:
        azimuth = side * self.rng.uniform(0.6, 1.5)
        away = self.rng.uniform(0.85, 1.3)
        x, y = away * np.cos(azimuth), away * np.sin(azimuth)
        at = np.array([0.35 + x, y, self.rng.uniform(0.35, 0.8)])
        middle = np.array([0.35, 0.0, 0.35]) + self.rng.uniform(-0.05, 0.05, 3)
        return look_at(at, middle)

    def _motion(self) -> np.ndarray:
        """(STEPS, 7) joint values with rests."""
        places = self.rng.uniform(LOW, HIGH, (6, 7))
        times = np.linspace(0, len(places) - 1, STEPS)
        before = np.minimum(times.astype(int), len(places) - 2)
        part = (times - before)[:, None]
        smooth = part**3 * (10 - 15 * part + 6 * part**2)
        return places[before] * (1 - smooth) + places[before + 1] * smooth

    def image(self, view: int, moved: bool, clip: int, step: int) -> np.ndarray:
        """(H, W, 3) uint8 RGB."""
        place = (self.moved if moved else self.places)[view]
        frames = self.body.frames(self.clips[clip][step : step + 1])[:, 0]
        wall = self._walls[2 * moved + view]
        image = _drawn(self.body, frames, place, self.camera, wall, self._light)
        image = cv2.resize(image, None, None, 0.5, 0.5, cv2.INTER_AREA)
        noise = self.rng.normal(0, 2.5, image.shape)
        return np.clip(255 * image + noise, 0, 255).astype(np.uint8)


def _bump(rng: np.random.Generator) -> SE3:
    shift = rng.normal(size=3)
    turn = rng.normal(size=3)
    shift *= rng.uniform(0.04, 0.12) / np.linalg.norm(shift)
    turn *= rng.uniform(0.03, 0.12) / np.linalg.norm(turn)
    return SE3.exp(np.concatenate([shift, turn]))


def _painted(rng: np.random.Generator, width: int, height: int) -> np.ndarray:
    """A background of shades, things with straight edges and texture, 0 to 1."""
    image = np.zeros((height, width, 3), np.float32)
    shades = rng.uniform(0.25, 0.8, (2, 1)) + rng.uniform(-0.06, 0.06, (2, 3))
    top, bottom = shades
    ramp = np.linspace(0, 1, height)[:, None, None]
    image[:] = top + (bottom - top) * ramp
    for _ in range(30):
        centre = rng.uniform(0, 1, 2) * [width, height]
        size = rng.uniform(0.02, 0.25, 2) * width
        box = cv2.boxPoints((centre.tolist(), size.tolist(), float(rng.uniform(0, 90))))
        grey = rng.uniform(0.05, 0.85)
        colour = np.clip(grey + rng.uniform(-0.12, 0.12, 3), 0, 1).tolist()
        cv2.fillConvexPoly(image, box.astype(np.int32), colour, cv2.LINE_AA)
    texture = np.zeros((height, width), np.float32)
    for octave in (4, 16, 64):
        coarse = rng.normal(0, 0.04, (height // octave + 2, width // octave + 2))
        texture += cv2.resize(coarse.astype(np.float32), (width, height))
    return np.clip(image + texture[..., None], 0, 1)


def _drawn(
    body: RobotBody,
    frames: np.ndarray,
    place: SE3,
    camera: Camera,
    wall: np.ndarray,
    light: np.ndarray,
) -> np.ndarray:
    """The arm before a wall, at twice the size of the camera's images."""
    towards = place.inverse().matrix()
    points, colours = [], []
    for shape, frame in zip(body.links, frames, strict=True):
        corners = shape.vertices[shape.faces] @ frame[:3, :3].T + frame[:3, 3]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        shade = 0.45 + 0.5 * np.clip(normal @ light / np.linalg.norm(light), -0.6, 1)
        tone = 0.25 if "hand" in shape.link or "finger" in shape.link else 0.95
        points.append(corners.reshape(-1, 3) @ towards[:3, :3].T + towards[:3, 3])
        colours.append(np.repeat(tone * shade, 3))
    at = np.concatenate(points) * [1, -1, -1]
    grey = np.repeat(np.concatenate(colours)[:, None], 3, 1).astype(np.float32)
    faces = np.arange(len(at), dtype=np.int32).reshape(-1, 3)
    image = wall.copy()
    depth = np.full(image.shape[:2], 50, np.float32)
    settings = cv2.TriangleRasterizeSettings()
    settings = settings.setCullingMode(cv2.RASTERIZE_CULLING_NONE)
    settings = settings.setShadingType(cv2.RASTERIZE_SHADING_FLAT)
    field = 2 * np.arctan(camera.height / 2 / camera.fy)
    cv2.triangleRasterize(
        at.astype(np.float32),
        faces,
        grey,
        image,
        depth,
        np.eye(4),
        field,
        0.05,
        50.0,
        settings,
    )
    return image


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


def write_video(path: Path, images: Iterable[np.ndarray]) -> None:
    """Write images as H.264."""
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream: Any = None
        for image in images:
            if stream is None:
                options = {"crf": "20", "preset": "veryfast", "g": "8"}
                stream = container.add_stream("libx264", rate=FPS, options=options)
                stream.height, stream.width = image.shape[:2]
                stream.pix_fmt = "yuv420p"
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def bodied(urdf: Path) -> RobotBody:
    """The arm without values of its fingers."""
    return robot_body(RobotModel(urdf), JOINTS)


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
    body = bodied(urdf)
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


def write_camera(folder: Path, camera: Camera) -> None:
    """Write the intrinsics."""
    names = ("width", "height", "fx", "fy", "cx", "cy")
    write_json(folder / "camera.json", {name: getattr(camera, name) for name in names})


def write_truth(folder: Path, truths: dict[str, Any]) -> None:
    """Write what is wrong, and the true poses; last."""
    write_json(folder / "truth.json", truths)


def write_lerobot(options: Options, urdf: Path, folder: Path) -> None:
    """Write a data set of LeRobot 3.0, as DROID's: a data file and videos for each cell."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    names = [*(f"joint_{i}" for i in range(7)), "gripper"]
    axes = ["x", "y", "z", "roll", "pitch", "yaw"]
    truths: dict[str, Any] = {}
    episodes: list[dict[str, Any]] = []
    rows: dict[str, list[Any]] = {}
    images: list[list[list[np.ndarray]]] = [[] for _ in CAMERAS]
    last: Made | None = None

    def flush(cell: int) -> None:
        path = folder / f"data/chunk-000/file-{cell:03d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table(rows), path)
        for camera, clips in zip(CAMERAS, images, strict=True):
            video = folder / "videos" / f"observation.images.{camera}"
            frames = (image for clip in clips for image in clip)
            write_video(video / f"chunk-000/file-{cell:03d}.mp4", frames)
            clips.clear()
        rows.clear()

    for item in made(options, urdf):
        cell = item.planned.cell
        if last is not None and last.planned.cell != cell:
            flush(last.planned.cell)
        last = item
        number = item.planned.number
        start = len(images[0]) * STEPS / FPS
        entry: dict[str, Any] = {"episode_index": number}
        for camera, clip, clips in zip(CAMERAS, item.clips, images, strict=True):
            prefix = f"videos/observation.images.{camera}"
            entry[f"{prefix}/chunk_index"] = 0
            entry[f"{prefix}/file_index"] = cell
            entry[f"{prefix}/from_timestamp"] = start
            clips.append(clip)
        episodes.append(entry)
        for i, joints in enumerate(item.joints):
            values = {
                "episode_index": number,
                "frame_index": i,
                "timestamp": i / FPS,
                "observation.state": [*joints.tolist(), 0.5],
            }
            for camera, pose in zip(CAMERAS, item.stated, strict=True):
                values[f"camera_extrinsics.{camera}"] = pose.tolist()
            for name, value in values.items():
                rows.setdefault(name, []).append(value)
        for view, camera in enumerate(CAMERAS):
            key = f"episode_{number:06d} camera_extrinsics.{camera}"
            pose = truth(item.cell, item.planned, view).matrix().tolist()
            truths[key] = {"mistake": item.planned.mistake, "base_from_camera": pose}
    assert last is not None
    flush(last.planned.cell)
    features: dict[str, Any] = {
        "observation.state": {"dtype": "float32", "names": {"axes": names}}
    }
    size = last.cell.camera
    for camera in CAMERAS:
        features[f"observation.images.{camera}"] = {
            "dtype": "video",
            "shape": [size.height, size.width, 3],
        }
        features[f"camera_extrinsics.{camera}"] = {
            "dtype": "float32",
            "names": {"axes": axes},
        }
    info = {
        "codebase_version": "v3.0",
        "fps": FPS,
        "total_episodes": options.episodes,
        "features": features,
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
    }
    meta = folder / "meta/episodes/chunk-000/file-000.parquet"
    meta.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.Table.from_pylist(episodes), meta)
    write_camera(folder.parent, size)
    write_json(folder / "meta/info.json", info)
    write_truth(folder.parent, truths)


def write_droid(options: Options, urdf: Path, folder: Path) -> None:
    """Write folders in DROID's layout."""
    import h5py

    truths: dict[str, Any] = {}
    for item in made(options, urdf):
        number = item.planned.number
        serials = [f"{20000000 + 10 * item.planned.cell + view}" for view in range(2)]
        stamp = f"2023-07-08-{number // 3600:02d}h-{number // 60 % 60:02d}m-{number % 60:02d}s"
        name = f"LAB{item.planned.cell}+0123abcd+{stamp}"
        root = folder / f"LAB{item.planned.cell}/success/2023-07-08/{number:06d}"
        metadata: dict[str, Any] = {"uuid": name, "timestamp": stamp}
        for view, serial in enumerate(serials):
            metadata[f"ext{view + 1}_cam_serial"] = serial
            metadata[f"ext{view + 1}_cam_extrinsics"] = item.stated[view].tolist()
            moved = item.planned.mistake == "moved"
            clip = f"{item.planned.cell}-{item.planned.clip}-{view}-{moved:d}.mp4"
            source = folder.parent / "clips" / clip
            if not source.exists():
                write_video(source, item.clips[view])
            video = root / "recordings/MP4" / f"{serial}.mp4"
            video.parent.mkdir(parents=True, exist_ok=True)
            video.hardlink_to(source)
            pose = truth(item.cell, item.planned, view).matrix().tolist()
            found = {"mistake": item.planned.mistake, "base_from_camera": pose}
            truths[f"{name} {serial}"] = found
        with h5py.File(root / "trajectory.h5", "w") as file:
            file["observation/robot_state/joint_positions"] = item.joints
        write_bytes(root / f"metadata_{name}.json", json.dumps(metadata).encode())
        write_camera(folder.parent, item.cell.camera)
    write_truth(folder.parent, truths)
