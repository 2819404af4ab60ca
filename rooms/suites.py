"""Suites of rendered rooms, written frame by frame in the generic folder format.

    OUT/bedroom/scene.json, images/, depth/            moving camera: train and test
    OUT/bedroom/calibration/fixed, bumped, hand        25 frames each, recordings of their own
    OUT/bedroom/calibration/truth.json                 the bump and gripper_from_camera
    OUT/bedroom/changed                                sim-mini: test frames after a change

Frames are written atomically and scene.json last, so an interrupted run continues with the first
missing frame. Rooms have fixed seeds; the option `seed` varies the paths.
"""

import shutil
from collections.abc import Generator, Iterable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3, Camera, pose_to_dict
from evercal.recordings import Frame, generic
from evercal.recordings.images import write_jpeg
from evercal.simulation.box_room import default_camera
from evercal.simulation.panda_arm import base_from_flange
from evercal.storage import write_bytes, write_json
from evercal.storage.settings import lock_settings
from rooms.changed import changed_room
from rooms.panda import panda_meshes
from rooms.paths import (
    Shot,
    changed_shots,
    fixed_shots,
    hand_camera,
    hand_joints,
    sees_work_area,
    sweep_shots,
)
from rooms.renderer import Renderer, RenderOptions, choose_variant, mitsuba
from rooms.room import KINDS, REPEATED, RESERVED, Room, room

CALIBRATION_FRAMES = 25
"""Frames of each calibration recording."""
Recordings = list[tuple[Path, list[Shot]]]
"""Folders of recordings, with their frames."""


@dataclass(frozen=True)
class Suite:
    """Rooms and default settings."""

    rooms: tuple[tuple[str, str, int], ...]
    """Recording name, room kind, room seed."""
    frames: int
    """Frames per room, train and test together."""
    size: tuple[int, int]
    """Width and height in pixels."""
    samples: int
    """Light paths per pixel."""
    depth: bool = True
    """Whether depth is written."""
    jpeg_quality: int = 95
    """JPEG quality of the colour images."""
    changed: int = 0
    """Test frames per room after small objects moved and lamps switched; see `changed_room`."""


def _rooms(kinds: Iterable[str], first_seed: int) -> tuple[tuple[str, str, int], ...]:
    """One room of each kind, with successive seeds."""
    return tuple((kind, kind, seed) for seed, kind in enumerate(kinds, first_seed))


def _numbered(count: int, first_seed: int) -> tuple[tuple[str, str, int], ...]:
    """Rooms bedroom-1, kitchen-1, living-1, bedroom-2, ..."""
    kinds = tuple(KINDS)
    return tuple(
        (f"{kinds[i % 3]}-{i // 3 + 1}", kinds[i % 3], first_seed + i)
        for i in range(count)
    )


_THREE = _rooms(KINDS, 101)
_SMALL = Suite(_THREE, 130, (320, 240), 16, depth=False, jpeg_quality=85)

# Rooms of no published table: settings of the networks are chosen on `sim-tune`, and confirmed on
# `sim-unseen`.
SUITES: dict[str, Suite] = {
    "sim": Suite(_THREE, 3300, (640, 480), 16),
    "sim-7": Suite(_numbered(7, 201), 1000, (320, 240), 16),
    "sim-12": Suite(_numbered(12, 301), 1000, (320, 240), 16),
    "sim-mini": replace(_SMALL, changed=20),
    "sim-tune": replace(_SMALL, rooms=_rooms(KINDS, 4001)),
    "sim-unseen": replace(_SMALL, rooms=_rooms(KINDS, 5001), frames=1000),
    "sim-repeat": replace(_SMALL, rooms=_rooms(REPEATED, 401)),
}


@dataclass(frozen=True)
class SimulateOptions:
    """Settings of a run. None selects the suite's default."""

    frames: int | None = None
    """Frames per room, train and test together."""
    size: tuple[int, int] | None = None
    """Width and height in pixels."""
    seed: int = 0
    """Seed of camera paths, arm paths and noise; below 9000."""
    samples: int | None = None
    """Light paths per pixel."""
    exposure_ev: float = 0.0
    """Exposure in stops; positive is brighter."""
    noise: float = 0.0
    """Standard deviation of sensor noise at mid grey, as a fraction of full scale."""
    blur_steps: int = 1
    """Poses per exposure; 1 disables motion blur."""
    sweep_only: bool = False
    """Whether calibration recordings and changed frames are left for a later run."""


@dataclass(frozen=True)
class Progress:
    """State of a run after one frame."""

    done: int
    """Completed frames, including those of earlier runs."""
    total: int
    """Frames of the whole suite."""
    scene: Path
    """Folder of the current recording."""
    renderer: str
    """Mitsuba version and variant, with the reason for the choice."""


def simulate(
    name: str, out: Path, options: SimulateOptions | None = None
) -> Generator[Progress, None, None]:
    """Render a suite and yield the progress after each frame.

    `out` is a new folder, or that of an interrupted run with the same settings.

    Raises:
        InputError: The suite is unknown, an option is out of range, the disk is too small, `out`
            was begun with other settings, or Mitsuba or the meshes of the arm are missing.
    """
    options = options or SimulateOptions()
    suite = _checked(name, options)
    frames = options.frames or suite.frames
    width, height = options.size or suite.size
    others = 0 if options.sweep_only else 3 * CALIBRATION_FRAMES + suite.changed
    total = (frames + others) * len(suite.rooms)
    render = RenderOptions(
        samples=options.samples or suite.samples,
        exposure_ev=options.exposure_ev,
        noise=options.noise,
        blur_steps=options.blur_steps,
    )
    settings: dict[str, object] = {
        "suite": name,
        "frames": frames,
        "size": [width, height],
        "seed": options.seed,
        "jpeg_quality": suite.jpeg_quality,
        **asdict(render),
    }
    missing = total
    for scene, *_ in suite.rooms:
        missing -= len(list((out / scene).glob("**/images/*.jpg")))
    pixel_bytes = 4 if suite.depth else 2
    _refuse_full_disk(out, missing * width * height * pixel_bytes)
    mi = mitsuba()
    settings["renderer"] = f"mitsuba {mi.__version__} {mi.variant()}"
    lock_settings(out / "render.json", settings)
    renderer = f"Mitsuba {mi.__version__}, {': '.join(choose_variant())}"
    done = 0
    for scene, kind, room_seed in suite.rooms:
        before = room(kind, room_seed)
        for state, recordings in _plans(before, out / scene, suite, options):
            camera = default_camera(width, height)
            writer = _Writer(state, camera, suite, options.seed, render, settings)
            for root, shots in recordings:
                for _ in writer.record(root, scene, shots):
                    done += 1
                    yield Progress(done, total, root, renderer)


def _plans(
    before: Room, folder: Path, suite: Suite, options: SimulateOptions
) -> list[tuple[Room, Recordings]]:
    """Plan the recordings of a room, and of the room after a change."""
    seed = options.seed
    sweep = sweep_shots(before, options.frames or suite.frames, seed)
    recordings = [(folder, sweep)]
    plans = [(before, recordings)]
    if options.sweep_only:
        return plans
    recordings += _calibrations(before, seed, folder / "calibration")
    if suite.changed:
        after = changed_room(before, seed)
        train = [shot.base_from_camera for shot in sweep if shot.split == "train"]
        shots = changed_shots(after, suite.changed, SE3.stack(train), seed)
        plans.append((after, [(folder / "changed", shots)]))
    return plans


def _checked(name: str, options: SimulateOptions) -> Suite:
    if name not in SUITES:
        raise InputError(f"suite {name!r} is not known; use one of {', '.join(SUITES)}")
    if not 0 <= options.seed < RESERVED:
        raise InputError(
            f"seed {options.seed}: use 0 to {RESERVED - 1}; higher ones are reserved"
        )
    if options.frames is not None and options.frames < 2:
        raise InputError(
            f"frames {options.frames}: a room takes at least 2, one per split"
        )
    if options.size is not None and min(options.size) < 16:
        raise InputError(f"size {options.size[0]}x{options.size[1]}: at least 16x16")
    for option, count in (
        ("samples", options.samples),
        ("blur steps", options.blur_steps),
    ):
        if count is not None and count < 1:
            raise InputError(f"{option} {count}: at least 1")
    if not options.noise >= 0:  # also nan
        raise InputError(f"noise {options.noise:g}: at least 0")
    return SUITES[name]


def _refuse_full_disk(out: Path, needed: int) -> None:
    """Refuse before hours of rendering fill the disk; `needed` is a generous estimate in bytes."""
    folder = out.resolve()
    while not folder.exists():
        folder = folder.parent
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise InputError(
            f"{out}: the frames take up to {needed / 1e9:.1f} GB and {free / 1e9:.1f} GB are free;"
            f" use fewer --frames, a smaller --size, or another --out"
        )


def _calibrations(before: Room, seed: int, folder: Path) -> Recordings:
    """Plan the calibration recordings of a room and write the true calibration."""
    fixed, bumped, bump = fixed_shots(before, CALIBRATION_FRAMES, seed)
    gripper_from_camera = hand_camera(seed)
    hand = _hand_shots(before, gripper_from_camera, seed)
    folder.mkdir(parents=True, exist_ok=True)
    truth = {
        "gripper_from_camera": gripper_from_camera,
        "fixed_camera_from_bumped_camera": bump,
    }
    poses = {name: pose_to_dict(pose) for name, pose in truth.items()}
    write_json(folder / "truth.json", poses)
    return [
        (folder / "fixed", fixed),
        (folder / "bumped", bumped),
        (folder / "hand", hand),
    ]


def _hand_shots(before: Room, gripper_from_camera: SE3, seed: int) -> list[Shot]:
    """Select free arm poses whose hand camera sees the work area."""
    shots: list[Shot] = []
    for joints in hand_joints(40 * CALIBRATION_FRAMES, seed):
        camera = base_from_flange(joints) @ gripper_from_camera
        eye = camera.translation_m
        if (
            eye[2] > 0.2
            and sees_work_area(camera)
            and before.is_free(eye[None], 0.05).all()
        ):
            shots.append(Shot(f"hand-{len(shots):06d}", "test", camera, joints))
        if len(shots) == CALIBRATION_FRAMES:
            return shots
    raise InputError(
        f"seed {seed}: too few free arm poses for a hand camera in {before.kind} {before.seed};"
        f" use another seed"
    )


@dataclass(eq=False)
class _Writer:
    """Renders the missing frames of recordings in one room."""

    room: Room
    camera: Camera
    suite: Suite
    seed: int
    options: RenderOptions
    settings: dict[str, object]
    _renderer: Renderer | None = field(default=None, init=False)
    _joints_rad: np.ndarray = field(default_factory=lambda: np.empty(0), init=False)

    def record(self, root: Path, scene: str, shots: list[Shot]) -> Iterator[None]:
        """Render missing frames, then write scene.json. Yields after each frame."""
        frames = []
        for i, shot in enumerate(shots):
            image = root / f"images/{i:06d}.jpg"
            depth = root / f"depth/{i:06d}.png"
            if not (image.exists() and (depth.exists() or not self.suite.depth)):
                following = shots[i + 1] if i + 1 < len(shots) else shot
                self._render(shot, following, i, image, depth)
            frames.append(
                Frame(
                    shot.name,
                    image,
                    self.camera,
                    shot.base_from_camera,
                    base_from_flange(shot.joints_rad),
                    depth if self.suite.depth else None,
                    tuple(float(angle) for angle in shot.joints_rad),
                )
            )
            yield
        if (root / generic.FILE).exists():
            return
        name = scene if root.name == scene else f"{scene}-{root.name}"
        with generic.SceneWriter(root, name) as writer:
            writer.render = {**self.settings, "room_seed": self.room.seed}
            for frame, shot in zip(frames, shots, strict=True):
                writer.add(frame, shot.split)

    def _render(
        self, shot: Shot, following: Shot, i: int, image: Path, depth: Path
    ) -> None:
        import cv2

        if self._renderer is None:
            self._renderer = Renderer(
                self.room.meshes() + panda_meshes(shot.joints_rad)
            )
        elif not np.array_equal(self._joints_rad, shot.joints_rad):
            arm = panda_meshes(shot.joints_rad)
            self._renderer.move(arm)
        self._joints_rad = shot.joints_rad
        path = _shutter(shot, following, self.options.blur_steps)
        # Every frame has its own noise pattern.
        origin = [self.room.seed, self.seed, i, *shot.name.encode()]
        seed = int(np.random.default_rng(origin).integers(2**31))
        colour = self._renderer.render(self.camera, path, self.options, seed)
        if self.suite.depth:
            metres = self._renderer.depth(self.camera, shot.base_from_camera)
            millimetres = np.round(np.minimum(metres, 65.0) * 1000).astype(np.uint16)
            depth.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(depth, cv2.imencode(".png", millimetres)[1].tobytes())
        write_jpeg(image, colour, self.suite.jpeg_quality)


def _shutter(shot: Shot, following: Shot, steps: int) -> SE3:
    """Poses over a third of the motion to the next frame, centred on the frame's own pose."""
    pose = shot.base_from_camera
    if steps <= 1 or following.split != shot.split:
        return pose
    change = (pose.inverse() @ following.base_from_camera).log()
    shares = (np.arange(steps) - (steps - 1) / 2) / max(steps - 1, 1) / 3
    return SE3.stack([pose @ SE3.exp(share * change) for share in shares])
