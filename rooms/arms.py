"""Recordings of a fixed camera before an arm that moves, with nothing in its gripper.

    OUT/NAME/recording/000.png, ..., joints.csv, camera.json, panda.urdf    a wrist recording
    OUT/NAME/truth.json        the true camera, joint values and the setting; written last

The URDF names the meshes of the package `example-robot-data` by their paths. A finished image is
not rendered again, and a recording can be continued with more images.
"""

import itertools
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.random import Generator

from evercal.errors import InputError
from evercal.geometry import SE3, Camera, pose_to_dict
from evercal.robot.robot_model import RobotModel
from evercal.simulation.box_room import look_at
from evercal.storage import write_bytes, write_json
from rooms.arm_shapes import ArmShapes
from rooms.drawn_arms import Stage, draw
from rooms.panda import panda_meshes, robots_folder
from rooms.renderer import Renderer, RenderOptions
from rooms.room import KINDS, RESERVED, Room, room

MOST_IMAGES = 40
"""Images of a recording; a shorter one is its beginning and can be continued."""
_SAMPLES = 4
"""Light paths per pixel."""
_NOISE = 0.012
"""Sensor noise, see `RenderOptions`."""


class ArmKind(NamedTuple):
    """An arm of `example-robot-data`."""

    urdf: str
    """File below the robots of the package, or a path."""
    joints: tuple[str, ...]
    low: tuple[float, ...]
    """Lowest drawn value of each joint, radians, or metres of sliding joints."""
    high: tuple[float, ...]
    tip: str
    """Link at the end of the arm."""
    middle_m: tuple[float, float, float]
    """Centre of the arm's motion."""
    reach_m: float
    """Distance from the middle that the arm reaches."""


_PANDA_JOINTS = (*(f"panda_joint{i}" for i in range(1, 8)), "panda_finger_joint1")
ARMS = {
    "panda": ArmKind(
        "panda_description/urdf/panda.urdf",
        _PANDA_JOINTS,
        (-1.9, -1.1, -1.3, -2.8, -1.8, 0.6, -2.2, 0.005),
        (1.9, 1.2, 1.3, -0.6, 1.8, 3.3, 2.5, 0.038),
        "panda_hand_tcp",
        (0.2, 0.0, 0.45),
        0.6,
    ),
    "ur5": ArmKind(
        "ur_description/urdf/ur5_robot.urdf",
        (
            "shoulder_pan_joint",
            "shoulder_lift_joint",
            "elbow_joint",
            "wrist_1_joint",
            "wrist_2_joint",
            "wrist_3_joint",
        ),
        (-2.0, -2.3, -2.2, -2.8, -2.5, -2.5),
        (2.0, -0.5, 2.2, 1.0, 2.5, 2.5),
        "tool0",
        (0.1, 0.0, 0.45),
        0.65,
    ),
    "xarm7": ArmKind(
        "xarm_description/urdf/xarm7.urdf",
        tuple(f"joint{i}" for i in range(1, 8)),
        (-2.0, -1.2, -1.5, 0.2, -2.0, -1.2, -2.5),
        (2.0, 1.2, 1.5, 2.6, 2.0, 2.2, 2.5),
        "link_eef",
        (0.1, 0.0, 0.4),
        0.55,
    ),
    "so101": ArmKind(
        "so_arm_description/urdf/so101.urdf",
        (
            "shoulder_pan",
            "shoulder_lift",
            "elbow_flex",
            "wrist_flex",
            "wrist_roll",
            "gripper",
        ),
        (-1.7, -1.6, -1.5, -1.5, -2.5, 0.0),
        (1.7, 1.3, 1.6, 1.5, 2.5, 1.5),
        "gripper_frame_link",
        (0.12, 0.0, 0.18),
        0.25,
    ),
    "kinova": ArmKind(
        "kinova_description/robots/kinova.urdf",
        tuple(f"j2s6s200_joint_{i}" for i in range(1, 7)),
        (-2.0, 1.6, 0.7, -2.0, 0.7, -2.5),
        (2.0, 4.6, 5.6, 2.0, 5.5, 2.5),
        "j2s6s200_end_effector",
        (0.1, 0.0, 0.45),
        0.6,
    ),
    "scara": ArmKind(
        str(Path(__file__).with_name("scara.urdf")),
        ("turn_1", "turn_2", "slide", "turn_3"),
        (-1.9, -2.2, -0.12, -3.0),
        (1.9, 2.2, 0.1, 3.0),
        "tool",
        (0.2, 0.0, 0.3),
        0.4,
    ),
}


@dataclass(frozen=True)
class Setting:
    """One recording."""

    seed: int
    """Room, camera and motion; below 9000."""
    arm: str = "panda"
    """A key of `ARMS`."""
    distance_m: float = 1.6
    """From the camera to the middle of the arm's motion."""
    size: tuple[int, int] = (640, 480)
    """Width and height of an image, pixels."""
    images: int = 25
    drawn: bool = False
    """Draw the arm into one picture of the room, see `rooms.drawn_arms`; arms other than the
    Panda are always drawn."""

    @property
    def name(self) -> str:
        """Folder of the recording."""
        size = "x".join(map(str, self.size))
        arm = f"drawn-{self.arm}" if self.drawn or self.arm != "panda" else self.arm
        return f"{arm}-{self.distance_m:g}-{size}-{self.seed}"


@dataclass(frozen=True, eq=False)
class Plan:
    """What happens in a recording."""

    room: Room
    camera: Camera
    base_from_camera: SE3
    joints: np.ndarray
    """(MOST_IMAGES, k) values of the arm's joints."""


def urdf_of(arm: str) -> Path:
    """URDF of an arm in the installed package."""
    return robots_folder() / ARMS[arm].urdf


def packaged_urdf(arm: str) -> str:
    """Text of the URDF of an arm, with the paths of its meshes."""
    packages = f"{robots_folder().parent.parent}/"
    return urdf_of(arm).read_text().replace("package://", packages)


def render(setting: Setting, out: Path) -> Iterator[int]:
    """Render the missing images of a recording, yielding the number of each.

    Raises:
        InputError: The seed is reserved, or the room has no place for such a camera.
    """
    root = out / setting.name
    truth = root / "truth.json"
    if truth.exists() and json.loads(truth.read_text())["images"] >= setting.images:
        return
    plan = make_plan(setting)
    folder = root / "recording"
    folder.mkdir(parents=True, exist_ok=True)
    if setting.name.startswith("drawn"):
        yield from _draw_images(setting, plan, folder)
    else:
        yield from _render_images(setting, plan, folder)
    write_recording(setting, plan, root)


def write_recording(setting: Setting, plan: Plan, root: Path) -> None:
    """Write the joint values, camera and URDF beside the images, and the truth."""
    folder = root / "recording"
    joints = plan.joints[: setting.images]
    write_joints(folder, ARMS[setting.arm].joints, joints)
    camera = asdict(plan.camera)
    del camera["distortion"]
    write_json(folder / "camera.json", camera)
    urdf = folder / urdf_of(setting.arm).name
    write_bytes(urdf, packaged_urdf(setting.arm).encode())
    truth = {**asdict(setting), "room": plan.room.kind}
    truth["base_from_camera"] = pose_to_dict(plan.base_from_camera)
    truth["joint_names"] = list(ARMS[setting.arm].joints)
    truth["joints"] = joints.tolist()
    write_json(root / "truth.json", truth)


def write_joints(folder: Path, names: tuple[str, ...], values: np.ndarray) -> None:
    """Write the joint values (n, k) of images 000.png, 001.png, ..."""
    text = ",".join(("image", *names)) + "\n"
    for i, row in enumerate(values):
        text += f"{i:03d}.png," + ",".join(f"{x:.9f}" for x in row) + "\n"
    write_bytes(folder / "joints.csv", text.encode())


def _render_images(setting: Setting, plan: Plan, folder: Path) -> Iterator[int]:
    options = RenderOptions(samples=_SAMPLES, noise=_NOISE)
    renderer = None
    for i in range(setting.images):
        path = folder / f"{i:03d}.png"
        if path.exists():
            continue
        *angles, opening = plan.joints[i]
        moving = panda_meshes(np.array(angles), opening)
        if renderer is None:
            renderer = Renderer(plan.room.meshes() + moving)
        else:
            renderer.move(moving)
        seed = int(np.random.default_rng([setting.seed, i, 41]).integers(2**31))
        rgb = renderer.render(plan.camera, plan.base_from_camera, options, seed)
        write_bytes(path, cv2.imencode(".png", rgb[..., ::-1])[1].tobytes())
        yield i


def _draw_images(setting: Setting, plan: Plan, folder: Path) -> Iterator[int]:
    renderer = Renderer(plan.room.meshes())
    options = RenderOptions(samples=_SAMPLES)
    rgb = renderer.render(plan.camera, plan.base_from_camera, options, setting.seed)
    depth = renderer.depth(plan.camera, plan.base_from_camera)
    rng = np.random.default_rng([setting.seed, 43])
    light = rng.uniform((-1.2, -1.2, 1.3), (1.2, 1.2, 1.7))
    stage = Stage(plan.camera, plan.base_from_camera, rgb, depth, light)
    shapes = ArmShapes(urdf_of(setting.arm), ARMS[setting.arm].joints)
    for i in range(setting.images):
        path = folder / f"{i:03d}.png"
        if not path.exists():
            rng = np.random.default_rng([setting.seed, i, 44])
            image = draw(shapes, plan.joints[i], stage, rng, _NOISE)
            write_bytes(path, cv2.imencode(".png", image[..., ::-1])[1].tobytes())
        yield i


def make_plan(setting: Setting) -> Plan:
    """Choose the room, a camera that sees the arm, and joint values of large motion."""
    seed = setting.seed
    if not 0 <= seed < RESERVED or setting.arm not in ARMS:
        raise InputError(f"seed {seed}, arm {setting.arm!r}: not a recording")
    scene = room(sorted(KINDS)[seed % len(KINDS)], seed)
    body = _Skeleton(setting.arm)
    for attempt in range(400):
        rng = np.random.default_rng([seed, attempt, 42])
        view = _view(setting, scene, rng)
        if view is None:
            continue
        joints = _motion(setting, scene, view, body, rng)
        if joints is not None:
            return Plan(scene, *view, joints)
    raise InputError(f"seed {seed}: no place for a camera; use another seed")


class _Skeleton:
    """Points along the bones of an arm."""

    def __init__(self, name: str) -> None:
        self.kind = ARMS[name]
        model = RobotModel(urdf_of(name))
        tip = model.arm(model.base_link, self.kind.tip)
        chains = {}
        for link in model.links:
            arm = model.arm(model.base_link, link)
            if arm.joints and arm.joints == tip.joints[: len(arm.joints)]:
                chains.setdefault(len(arm.joints), arm)
        self.arms = [arm for _, arm in sorted(chains.items())] + [tip]

    def points(self, joints: np.ndarray) -> np.ndarray:
        """(n, 3) points from the second joint to the tip, 4 cm apart or less."""
        ends = []
        for arm in self.arms:
            values = [joints[self.kind.joints.index(name)] for name in arm.joints]
            ends.append(arm.poses(np.array([values])).translation_m[0])
        points = []
        for a, b in itertools.pairwise(ends):
            steps = np.linspace(0, 1, int(np.linalg.norm(b - a) / 0.04) + 2)
            points.append(a + steps[:, None] * (b - a))
        return np.concatenate(points)


def _view(setting: Setting, scene: Room, rng: Generator) -> tuple[Camera, SE3] | None:
    """Draw a camera; None where the room is not free between it and the arm."""
    kind = ARMS[setting.arm]
    width, height = setting.size
    focal = width * rng.uniform(0.85, 1.1)
    centre = (np.array([width, height]) - 1) / 2 + 0.01 * width * rng.normal(size=2)
    camera = Camera(width, height, focal, focal, *centre.tolist())
    azimuth = rng.uniform(-np.pi, np.pi)
    elevation = np.deg2rad(rng.uniform(10, 60))
    towards = np.array([np.cos(azimuth), np.sin(azimuth), 0.0]) * np.cos(elevation)
    towards[2] = np.sin(elevation)
    middle = np.array(kind.middle_m)
    eye = middle + setting.distance_m * towards
    targets = middle + 0.5 * kind.reach_m * rng.uniform(-1, 1, (12, 3))
    lines = eye + np.linspace(0, 1, 25)[:, None, None] * (targets - eye)
    lines = lines[lines[..., 2] > 0.02]
    if not scene.is_free(lines, 0.03).all() or not scene.is_free(eye[None], 0.1).all():
        return None
    aim = middle + 0.1 * setting.distance_m * rng.uniform(-1, 1, 3)
    return camera, look_at(eye, aim, rng.uniform(-0.15, 0.15))


def _motion(
    setting: Setting,
    scene: Room,
    view: tuple[Camera, SE3],
    body: _Skeleton,
    rng: Generator,
) -> np.ndarray | None:
    """Joint values of all images, or None where the camera sees too little of the arm."""
    camera, base_from_camera = view
    inside = 0.9 if setting.distance_m >= 1.2 else 0.7
    found: list[np.ndarray] = []
    for attempt in range(60 * MOST_IMAGES):
        if attempt == 300 and len(found) < 3:
            return None
        joints = rng.uniform(body.kind.low, body.kind.high)
        points = body.points(joints)
        if not _possible(points, scene, body.kind.reach_m):
            continue
        seen = base_from_camera.inverse().apply(points)
        away = np.linalg.norm(seen, axis=1).min()
        if away < 0.3 * setting.distance_m or seen[:, 2].min() < 0.1:
            continue
        pixels = camera.project(seen)
        high = (camera.width - 1, camera.height - 1)
        if ((pixels >= 0) & (pixels <= high)).all(1).mean() >= inside:
            found.append(joints)
        if len(found) == MOST_IMAGES:
            return np.stack(found)
    return None


def _possible(points: np.ndarray, scene: Room, reach_m: float) -> bool:
    """Whether an arm along points is above its table, free, and not in its own way."""
    half = len(points) // 2
    last = points[half:]
    unit = reach_m / 0.6
    along = np.append(0, np.linalg.norm(np.diff(points, axis=0), axis=1).cumsum())
    far = np.abs(along[:, None] - along) > 0.4 * unit
    apart = np.linalg.norm(points[:, None] - points, axis=-1)
    column = np.hypot(*last[:, :2].T) + np.maximum(0, last[:, 2] - 0.4 * unit)
    if last[:, 2].min() < 0.09 * unit or column.min() < 0.2 * unit:
        return False
    if apart[far].min(initial=1) < 0.15 * unit:
        return False
    return bool(scene.is_free(points[half // 2 :], 0.05 * unit).all())
