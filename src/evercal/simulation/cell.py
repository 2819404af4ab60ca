"""Suites of rendered rooms, written frame by frame in the generic folder format.

    OUT/bedroom/scene.json, images/, depth/            the moving camera: train and test
    OUT/bedroom/calibration/fixed, bumped, hand        25 frames each, scenes of their own
    OUT/bedroom/calibration/truth.json                 the bump and gripper_from_camera
    OUT/bedroom/changed                                sim-mini: test frames after a change

A frame appears under its name only when it is whole, and scene.json comes last: a run that was cut
off goes on where it stopped. Rooms have fixed seeds; `seed` draws the paths.
"""

import shutil
from collections.abc import Generator, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings import Frame, generic
from evercal.simulation.box_room import default_camera
from evercal.simulation.cell_paths import (
    Shot,
    changed_shots,
    fixed_shots,
    hand_camera,
    hand_joints,
    hand_shots,
    sees_work_area,
    sweep_shots,
)
from evercal.simulation.changed_room import changed_room
from evercal.simulation.furnished.panda import Panda
from evercal.simulation.furnished.renderer import Renderer, RenderOptions, choose_variant, mitsuba
from evercal.simulation.furnished.rooms import RESERVED, Room, room
from evercal.storage import lock_settings, write_bytes, write_json

CALIBRATION_FRAMES = 25


@dataclass(frozen=True)
class Suite:
    """What one name stands for."""

    rooms: tuple[tuple[str, str, int], ...]
    """Scene name, room kind, room seed."""
    frames: int
    """Frames per room, train and test together."""
    size: tuple[int, int]
    """Width and height in pixels."""
    samples: int
    """Paths per pixel."""
    depth: bool = True
    """Whether depth is written."""
    jpeg_quality: int = 95
    """Of the colour images."""
    changed: int = 0
    """Test frames per room after small things were moved and lamps switched; see `changed_room`."""


_CYCLE = ("bedroom", "kitchen", "living")


def _numbered(count: int, first_seed: int) -> tuple[tuple[str, str, int], ...]:
    kinds = [_CYCLE[i % 3] for i in range(count)]
    return tuple((f"{kind}-{i // 3 + 1}", kind, first_seed + i) for i, kind in enumerate(kinds))


_THREE = (("bedroom", "bedroom", 101), ("kitchen", "kitchen", 102), ("living", "living", 103))

SUITES: dict[str, Suite] = {
    "sim": Suite(_THREE, 3300, (640, 480), 16),
    "sim-7": Suite(_numbered(7, 201), 1000, (320, 240), 16),
    "sim-12": Suite(_numbered(12, 301), 1000, (320, 240), 16),
    "sim-mini": Suite(_THREE, 130, (320, 240), 16, depth=False, jpeg_quality=85, changed=20),
}


@dataclass(frozen=True)
class SimulateOptions:
    """What a run may change of its suite; None keeps the suite's own."""

    frames: int | None = None
    """Frames per room, train and test together."""
    size: tuple[int, int] | None = None
    """Width and height in pixels."""
    seed: int = 0
    """Of the camera and arm paths and of the noise; below 9000."""
    samples: int | None = None
    """Paths per pixel."""
    exposure_ev: float = 0.0
    """Brighter (> 0) or darker, in stops."""
    noise: float = 0.0
    """Sensor noise at mid grey in parts of full scale; 0.01 is a good camera."""
    blur_steps: int = 1
    """Poses per frame while the shutter is open; 1 is no motion blur."""


@dataclass(frozen=True)
class Progress:
    """After a frame: how many are done of how many, and where the last one went."""

    done: int
    """Frames that are there, this run's and earlier ones."""
    total: int
    """Frames of the whole suite."""
    scene: Path
    """The recording's folder."""
    renderer: str
    """Which Mitsuba variant draws, and why that one."""


def simulate(
    name: str, out: Path, options: SimulateOptions | None = None
) -> Generator[Progress, None, None]:
    """Renders a suite; a generator that says after each frame how far it is.

    Args:
        name: one of `SUITES`.
        out: a new folder, or one that the same call began.
        options: what differs from the suite.

    Raises:
        InputError: Unknown suite, unusable options, no room on the disk, a folder begun with other
            settings, or the extra `sim` is missing.
    """
    options = options or SimulateOptions()
    suite = _checked(name, options)
    frames = options.frames or suite.frames
    width, height = options.size or suite.size
    per_room = frames + 3 * CALIBRATION_FRAMES + suite.changed
    total, done = per_room * len(suite.rooms), 0
    taken = RenderOptions(
        samples=suite.samples if options.samples is None else options.samples,
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
        **asdict(taken),
    }
    there = sum(1 for scene, *_ in suite.rooms for _ in (out / scene).glob("**/images/*.jpg"))
    _refuse_full_disk(out, (total - there) * width * height * (4 if suite.depth else 2))
    mi = mitsuba()
    settings["renderer"] = f"mitsuba {mi.__version__} {mi.variant()}"
    lock_settings(out / "render.json", settings)
    said = f"Mitsuba {mi.__version__}, {': '.join(choose_variant())}"
    camera = default_camera(width, height)
    panda = Panda()
    for scene, kind, room_seed in suite.rooms:
        place = room(kind, room_seed)
        recordings = _recordings(place, panda, frames, options.seed, out / scene)
        plans = [(place, recordings)]
        if suite.changed:
            later, sweep = changed_room(place, options.seed), recordings[0][1]
            train = SE3.stack([shot.base_from_camera for shot in sweep if shot.split == "train"])
            shots = changed_shots(later, suite.changed, train, options.seed)
            plans.append((later, [(out / scene / "changed", shots)]))
        for where, recordings in plans:
            writer = _Writer(where, panda, camera, suite, options.seed, taken, settings)
            for root, shots in recordings:
                for _ in writer.record(root, scene, shots):
                    done += 1
                    yield Progress(done, total, root, said)


def _checked(name: str, options: SimulateOptions) -> Suite:
    if name not in SUITES:
        raise InputError(f"suite {name!r} is not known; use one of {', '.join(SUITES)}")
    if not 0 <= options.seed < RESERVED:
        raise InputError(f"seed {options.seed}: use 0 to {RESERVED - 1}; later ones are reserved")
    if options.frames is not None and options.frames < 2:
        raise InputError(f"frames {options.frames}: a room takes at least 2, one per split")
    if options.size is not None and min(options.size) < 16:
        raise InputError(f"size {options.size[0]}x{options.size[1]}: at least 16x16")
    for what, count in (("samples", options.samples), ("blur steps", options.blur_steps)):
        if count is not None and count < 1:
            raise InputError(f"{what} {count}: at least 1")
    if not options.noise >= 0:  # also nan
        raise InputError(f"noise {options.noise:g}: at least 0")
    return SUITES[name]


def _refuse_full_disk(out: Path, needed: int) -> None:
    """A generous guess of what is yet to be written, before hours of rendering fill the disk."""
    place = out.resolve()
    while not place.exists():
        place = place.parent
    free = shutil.disk_usage(place).free
    if needed > free:
        raise InputError(
            f"{out}: the frames take up to {needed / 1e9:.1f} GB and {free / 1e9:.1f} GB are free;"
            f" ask for fewer --frames, a smaller --size, or another --out"
        )


def _recordings(
    place: Room, panda: Panda, frames: int, seed: int, root: Path
) -> list[tuple[Path, list[Shot]]]:
    """All recordings of a room; writes the truth of the calibration ones."""
    fixed, bumped, bump = fixed_shots(place, CALIBRATION_FRAMES, seed)
    gripper_from_camera = hand_camera(seed)
    joints, flanges = [], []
    for angles in hand_joints(40 * CALIBRATION_FRAMES, seed):
        flange = panda.base_from_flange(angles)
        camera = flange @ gripper_from_camera
        eye = camera.translation_m
        if eye[2] > 0.2 and sees_work_area(camera) and place.is_free(eye[None], 0.05).all():
            joints.append(angles)
            flanges.append(flange)
        if len(joints) == CALIBRATION_FRAMES:
            break
    else:
        raise InputError(
            f"seed {seed}: too few free arm poses for a hand camera in {place.kind} {place.seed};"
            f" take another seed"
        )
    hand = hand_shots(flanges, np.array(joints), gripper_from_camera)
    folder = root / "calibration"
    folder.mkdir(parents=True, exist_ok=True)
    write_json(
        folder / "truth.json",
        {
            "gripper_from_camera": generic.pose_to_dict(gripper_from_camera),
            "fixed_camera_from_bumped_camera": generic.pose_to_dict(bump),
        },
    )
    return [
        (root, sweep_shots(place, frames, seed)),
        (folder / "fixed", fixed),
        (folder / "bumped", bumped),
        (folder / "hand", hand),
    ]


class _Writer:
    """Renders the missing frames of recordings in one room."""

    def __init__(
        self,
        place: Room,
        panda: Panda,
        camera: Camera,
        suite: Suite,
        seed: int,
        options: RenderOptions,
        settings: dict[str, object],
    ):
        self._place, self._panda, self._camera = place, panda, camera
        self._suite, self._seed, self._options, self._settings = suite, seed, options, settings
        self._renderer: Renderer | None = None
        self._joints: np.ndarray | None = None

    def record(self, root: Path, scene: str, shots: list[Shot]) -> Iterator[None]:
        """Renders what is not there yet, then writes scene.json; yields after each frame."""
        frames = []
        for i, shot in enumerate(shots):
            image, depth = root / f"images/{i:06d}.jpg", root / f"depth/{i:06d}.png"
            if not (image.exists() and (depth.exists() or not self._suite.depth)):
                following = shots[i + 1] if i + 1 < len(shots) else shot
                self._render(shot, following, i, image, depth)
            frames.append(
                Frame(
                    shot.name,
                    image,
                    self._camera,
                    shot.base_from_camera,
                    self._panda.base_from_flange(shot.joints_rad),
                    depth if self._suite.depth else None,
                    tuple(float(angle) for angle in shot.joints_rad),
                )
            )
            yield
        if (root / generic.FILE).exists():
            return
        name = scene if root.name == scene else f"{scene}-{root.name}"
        with generic.SceneWriter(root, name) as writer:
            writer.render = {**self._settings, "room_seed": self._place.seed}
            for frame, shot in zip(frames, shots, strict=True):
                writer.add(frame, shot.split)

    def _render(self, shot: Shot, following: Shot, i: int, image: Path, depth: Path) -> None:
        import cv2

        options = self._options
        if self._renderer is None:
            arm = self._panda.meshes(shot.joints_rad)
            self._renderer = Renderer(self._place.meshes() + arm)
        elif self._joints is None or (self._joints != shot.joints_rad).any():
            self._renderer.move({m.name: m for m, _ in self._panda.meshes(shot.joints_rad)})
        self._joints = shot.joints_rad
        path = _shutter(shot, following, options.blur_steps)
        # No two frames have one pattern of noise.
        origin = [self._place.seed, self._seed, i, *shot.name.encode()]
        seed = int(np.random.default_rng(origin).integers(2**31))
        colour = self._renderer.render(self._camera, path, options, seed)
        if self._suite.depth:
            metres = self._renderer.depth(self._camera, shot.base_from_camera)
            millimetres = np.round(np.minimum(metres, 65.0) * 1000).astype(np.uint16)
            depth.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(depth, cv2.imencode(".png", millimetres)[1].tobytes())
        quality = [cv2.IMWRITE_JPEG_QUALITY, self._suite.jpeg_quality]
        bgr = np.ascontiguousarray(colour[..., ::-1])
        image.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(image, cv2.imencode(".jpg", bgr, quality)[1].tobytes())


def _shutter(shot: Shot, following: Shot, steps: int) -> SE3:
    """Poses over a third of the way to the next frame, centred on the frame's own pose."""
    pose = shot.base_from_camera
    if steps <= 1 or following.split != shot.split:
        return pose
    change = (pose.inverse() @ following.base_from_camera).log()
    shares = (np.arange(steps) - (steps - 1) / 2) / max(steps - 1, 1) / 3
    return SE3.stack([pose @ SE3.exp(share * change) for share in shares])
