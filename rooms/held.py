"""Recordings of a fixed camera before a Panda that holds a thing and turns it.

    OUT/NAME/recording/000.png, ..., base_from_gripper.csv, camera.json    a wrist recording
    OUT/NAME/truth.json        true poses, joint angles, the thing; written last

The gripper frame is the flange. The thing's frame has its origin in its middle, z away from the
gripper and its front at +y. A finished image is not rendered again, and a
recording can be continued with more images.
"""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.random import Generator

from evercal.errors import InputError
from evercal.geometry import SE3, Camera, pose_to_dict
from evercal.simulation.box_room import look_at
from evercal.simulation.panda_arm import (
    HOME_RAD,
    base_from_flange,
    joint_frames,
    joints_for,
)
from evercal.storage import write_bytes, write_json
from rooms.changed import rearranged
from rooms.items import Parts
from rooms.panda import panda_meshes
from rooms.renderer import Renderer, RenderOptions
from rooms.room import KINDS, RESERVED, Room, room
from rooms.things import SIZES_M, people, thing_parts

FAULTS = (
    "slip", "smooth", "repeats", "shiny", "out", "hidden", "still", "axis", "bump", "change",
    "people", "bare",
)  # fmt: skip
"""Assumptions that fail while a recording is made."""
FARTHEST_M = 1.5
"""Largest distance from the camera; a thing that must look smaller is smaller."""
MOST_IMAGES = 40
"""Images of a recording; a shorter one is its beginning and can be continued."""
TURN_DEG = 32.0
"""Largest turn about each axis of the thing to either side."""
_GRIPPED_M = 0.02
"""Length of a thing at its full size between the fingers, metres."""
_TIPS_M = 0.112
"""Distance from the flange to the tips of the fingers, metres."""
_SAMPLES = 4
"""Light paths per pixel."""
_NOISE = 0.012
"""Sensor noise, see `RenderOptions`."""
_ARM_SIGMA = np.repeat([1e-4, np.deg2rad(0.02)], 3)
"""Standard deviation of the written gripper poses, metres and radians."""


@dataclass(frozen=True)
class Setting:
    """One recording."""

    seed: int
    """Room, camera, thing and motion; below 9000."""
    thing: str = "box"
    """A key of `SIZES_M`."""
    px: int = 200
    """Length of the thing in the image."""
    size: tuple[int, int] = (640, 480)
    """Width and height of an image, pixels."""
    images: int = 25
    fault: str = ""
    """One of `FAULTS`, or none."""

    @property
    def name(self) -> str:
        """Folder of the recording."""
        size = "x".join(map(str, self.size))
        return f"{self.thing}-{self.px}-{size}-{self.fault or 'plain'}-{self.seed}"


@dataclass(frozen=True, eq=False)
class Plan:
    """What happens in a recording; poses have shape (images,)."""

    room: Room
    camera: Camera
    base_from_camera: SE3
    base_from_gripper: SE3
    gripper_from_thing: SE3
    joints_rad: np.ndarray
    """(images, 7)."""
    scale: float
    """Size of the thing in parts of `SIZES_M`."""


def render(setting: Setting, out: Path) -> Iterator[int]:
    """Render the missing images of a recording, yielding the number of each, then write its poses.

    Raises:
        InputError: The seed is reserved, or the room has no place for such a camera.
    """
    root = out / setting.name
    folder = root / "recording"
    if _finished(root) >= setting.images:
        return
    plan = make_plan(setting)
    folder.mkdir(parents=True, exist_ok=True)
    yield from _render_images(setting, plan, folder)
    rng = np.random.default_rng([setting.seed, 23])
    noise = SE3.exp(rng.normal(0, _ARM_SIGMA, (setting.images, 6)))
    write_poses(folder, plan.base_from_gripper @ noise)
    camera = asdict(plan.camera)
    del camera["distortion"]
    write_json(folder / "camera.json", camera)
    write_json(root / "truth.json", _truth(setting, plan))


def _render_images(setting: Setting, plan: Plan, folder: Path) -> Iterator[int]:
    thing = []
    persons = []
    if setting.fault != "bare":
        thing = thing_parts(setting.thing, setting.fault, plan.scale, setting.seed)
    if setting.fault == "people":
        persons = people(setting.seed)
    opening = SIZES_M[setting.thing][1] * plan.scale / 2
    base_from_thing = plan.base_from_gripper @ plan.gripper_from_thing
    options = RenderOptions(samples=_SAMPLES, noise=_NOISE)
    renderer = None
    state = plan.room
    for i in range(setting.images):
        path = folder / f"{i:03d}.png"
        if path.exists():
            continue
        moving = panda_meshes(plan.joints_rad[i], opening)
        moving += _moved(thing, base_from_thing[i].matrix())
        for number, person in enumerate(persons):
            moving += _moved(person, _walk(plan, [setting.seed, i, number]))
        changes = setting.fault == "change" and i >= setting.images // 2
        if changes and state is plan.room:
            state = rearranged(plan.room, setting.seed)
            renderer = None
        if renderer is None:
            renderer = Renderer(state.meshes() + moving)
        else:
            renderer.move(moving)
        seed = int(np.random.default_rng([setting.seed, i, setting.px]).integers(2**31))
        rgb = renderer.render(plan.camera, plan.base_from_camera[i], options, seed)
        write_bytes(path, cv2.imencode(".png", rgb[..., ::-1])[1].tobytes())
        yield i


def _finished(root: Path) -> int:
    """Number of images of a complete recording, or 0."""
    file = root / "truth.json"
    if not file.exists():
        return 0
    return json.loads(file.read_text())["images"]


def write_poses(folder: Path, base_from_gripper: SE3) -> None:
    """Write the pose file of a recording with images 000.png, 001.png, ..."""
    numbers = np.c_[base_from_gripper.translation_m, base_from_gripper.rotation_wxyz]
    text = "image,x,y,z,qw,qx,qy,qz\n"
    for i, row in enumerate(numbers):
        text += f"{i:03d}.png," + ",".join(f"{x:.9f}" for x in row) + "\n"
    write_bytes(folder / "base_from_gripper.csv", text.encode())


def _truth(setting: Setting, plan: Plan) -> dict[str, object]:
    truth = {
        **asdict(setting),
        "room": plan.room.kind,
        "scale": plan.scale,
        "joints_rad": plan.joints_rad.tolist(),
    }
    for name in ("base_from_camera", "base_from_gripper", "gripper_from_thing"):
        truth[name] = [pose_to_dict(pose) for pose in getattr(plan, name)]
    return truth


def make_plan(setting: Setting) -> Plan:
    """Choose the room, the camera, and arm poses that show the thing's front to the camera."""
    seed = setting.seed
    if not 0 <= seed < RESERVED or setting.fault not in ("", *FAULTS):
        raise InputError(f"seed {seed}, fault {setting.fault!r}: not a recording")
    scene = room(sorted(KINDS)[seed % len(KINDS)], seed)
    for attempt in range(60):
        rng = np.random.default_rng([seed, attempt, 21])
        view = _view(setting, scene, rng)
        if view is None:
            continue
        poses = _arm_poses(setting, view, rng)
        if poses is None:
            continue
        joints = np.stack(poses)[: setting.images]
        plan = Plan(
            scene,
            view.camera,
            SE3.stack([view.base_from_camera] * len(joints)),
            SE3.stack([base_from_flange(angles) for angles in joints]),
            SE3.stack([view.gripper_from_thing] * len(joints)),
            joints,
            view.scale,
        )
        return _with_break(setting, plan, rng)
    raise InputError(f"seed {seed}: no place for a camera; use another seed")


class _View(NamedTuple):
    """A camera before the thing."""

    camera: Camera
    base_from_camera: SE3
    middle_m: np.ndarray
    """Centre of the thing's motion."""
    facing_rad: float
    """Yaw of the thing's front, which is towards the camera."""
    gripper_from_thing: SE3
    scale: float


def _view(setting: Setting, scene: Room, rng: Generator) -> _View | None:
    """Draw a camera and a grip; None where the room is not free between camera and thing."""
    width, height = setting.size
    focal = width * rng.uniform(0.85, 1.15)
    if width >= 1000:
        focal *= 0.9
    centre = (np.array([width, height]) - 1) / 2 + 0.01 * width * rng.normal(size=2)
    camera = Camera(width, height, focal, focal, *centre.tolist())
    length = SIZES_M[setting.thing][2]
    scale = min(1.0, setting.px * FARTHEST_M / focal / length)
    distance = focal * scale * length / setting.px
    middle = rng.uniform((0.45, -0.12, 0.4), (0.58, 0.12, 0.5))
    azimuth = rng.uniform(-1.0, 1.0)
    elevation = rng.uniform(-0.05, 0.55)
    if setting.fault == "hidden":
        azimuth = np.pi + 0.3 * azimuth  # the arm is between
    towards = np.array([np.cos(azimuth), np.sin(azimuth), 0.0]) * np.cos(elevation)
    towards[2] = np.sin(elevation)
    eye = middle + distance * towards
    line = middle + np.linspace(0, 1, 30)[:, None] * (eye - middle)
    around = middle + rng.uniform(-0.2, 0.2, (50, 3))
    if not (scene.is_free(line, 0.04).all() and scene.is_free(around, 0.0).all()):
        return None
    aside = (0.42 if setting.fault == "out" else 0.08) * distance * width / focal
    aim = middle + aside * rng.choice([-1, 1]) * np.cross(towards, [0.0, 0, 1])
    aim += rng.uniform(-0.1, 0.1, 3) * distance / 3
    base_from_camera = look_at(eye, aim, rng.uniform(-0.1, 0.1))
    grip = _grip(setting, scale, rng)
    facing = np.arctan2(towards[1], towards[0]) + rng.uniform(-0.35, 0.35)
    return _View(camera, base_from_camera, middle, facing, grip, scale)


def _grip(setting: Setting, scale: float, rng: Generator) -> SE3:
    """gripper_from_thing; the fingers close along the thing's y."""
    length = SIZES_M[setting.thing][2] * scale
    hand = SE3.exp([0, 0, _TIPS_M - _GRIPPED_M * scale + length / 2, 0, 0, 0])
    hand = SE3.exp([0, 0, 0, 0, 0, -np.pi / 4]) @ hand
    tilt = rng.uniform(-1, 1, 3) * np.deg2rad((2.0, 12.0, 2.0))
    return hand @ SE3.exp([*rng.uniform(-0.01, 0.01, 3), *tilt])


def _arm_poses(
    setting: Setting, view: _View, rng: Generator
) -> list[np.ndarray] | None:
    """Joint angles of each image, or None where the arm reaches too few poses."""
    # z of the thing points down and its front, y, to the camera.
    y = np.array([np.cos(view.facing_rad), np.sin(view.facing_rad), 0.0])
    z = np.array([0.0, 0.0, -1.0])
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([np.cross(y, z), y, z], -1)
    upright = SE3.from_matrix(matrix)
    sides = np.array(SIZES_M[setting.thing]) * view.scale
    corners = (np.indices((2, 2, 2)).reshape(3, -1).T - 0.5) * sides
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    poses = []
    start = HOME_RAD
    for attempt in range(8 * MOST_IMAGES):
        turn = np.deg2rad(TURN_DEG) * rng.uniform(-1, 1, 3)
        if setting.fault == "still":
            turn *= 0.04
        elif setting.fault == "axis":
            turn = axis * turn[0]
        place = view.middle_m + 0.35 * sides[2] * rng.uniform(-1, 1, 3)
        thing = SE3.from_translation(place) @ upright @ SE3.exp([0, 0, 0, *turn])
        seen = view.base_from_camera.inverse().apply(thing.apply(corners))
        pixels = view.camera.project(seen)
        if setting.fault != "out" and not camera_holds(view.camera, pixels):
            continue
        flange = thing @ view.gripper_from_thing.inverse()
        try:
            joints = joints_for(flange, start, len(poses))
        except InputError:
            if not poses and attempt > 10:
                return None
            continue
        links = joint_frames(joints)[1:, :3, 3]
        away = np.linalg.norm(links - view.base_from_camera.translation_m, axis=1)
        if links[:, 2].min() > 0.1 and away.min() > 0.2:
            poses.append(joints)
            start = joints
        if len(poses) == MOST_IMAGES:
            return poses
    return None


def camera_holds(camera: Camera, pixels: np.ndarray) -> bool:
    """Whether pixels (n, 2) are at least 4 px inside the image."""
    high = (camera.width - 5, camera.height - 5)
    return bool(((pixels >= 4) & (pixels <= high)).all())


def _with_break(setting: Setting, plan: Plan, rng: Generator) -> Plan:
    """Let the thing slip at a random image, or bump the camera half way."""
    n = setting.images
    signs = rng.choice([-1, 1], 6) * rng.dirichlet(np.ones(3), 2).ravel() ** 0.5
    if setting.fault == "slip":
        first = rng.integers(n // 4, 3 * n // 4 + 1)
        metres = rng.uniform(0.001, 0.01)
        degrees = rng.uniform(1, 3)
    elif setting.fault == "bump":
        first = n // 2
        metres = rng.uniform(0.005, 0.02)
        degrees = rng.uniform(0.5, 2)
    else:
        return plan
    change = signs * np.repeat([metres, np.deg2rad(degrees)], 3)
    steps = SE3.exp(np.where(np.arange(n)[:, None] < first, 0.0, change))
    if setting.fault == "slip":
        return replace(plan, gripper_from_thing=plan.gripper_from_thing @ steps)
    return replace(plan, base_from_camera=plan.base_from_camera @ steps)


def _walk(plan: Plan, seed: list[int]) -> np.ndarray:
    """base_from_person: beyond the arm, in the camera's view."""
    rng = np.random.default_rng(seed)
    ahead = plan.base_from_camera[0].rotation_matrix()[:2, 2]
    ahead = ahead / np.linalg.norm(ahead)
    arm = plan.base_from_gripper.translation_m.mean(0)[:2]
    beyond = arm + rng.uniform(0.5, 1.4) * ahead
    aside = rng.uniform(-0.6, 0.6) * np.array([-ahead[1], ahead[0]])
    matrix = SE3.exp([0, 0, 0, 0, 0, rng.uniform(-3, 3)]).matrix()
    matrix[:3, 3] = [*(beyond + aside), plan.room.low_m[2]]
    return matrix


def _moved(parts: Parts, matrix: np.ndarray) -> Parts:
    return [(mesh.transformed(matrix), material) for mesh, material in parts]
