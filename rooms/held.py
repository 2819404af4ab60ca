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

import numpy as np
from numpy.random import Generator

from evercal.calibration.boards.board import Board
from evercal.calibration.boards.printing import board_image
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, pose_to_dict
from evercal.simulation.box_room import look_at
from evercal.simulation.panda_arm import (
    HOME_RAD,
    base_from_flange,
    joint_frames,
    joints_for,
)
from evercal.simulation.textures import dead_leaves
from evercal.storage import write_bytes, write_json
from evercal.typing import Array
from rooms.changed import rearranged
from rooms.materials import Material, fabric, plain
from rooms.panda import panda_meshes
from rooms.prints import label, spines
from rooms.renderer import Renderer, RenderOptions
from rooms.room import KINDS, RESERVED, Room, room
from rooms.shapes import Mesh, ball, lathe, sheet

Parts = list[tuple[Mesh, Material]]
SIZES_M = {
    "box": (0.16, 0.055, 0.24),
    "bottle": (0.06, 0.06, 0.24),
    "book": (0.16, 0.03, 0.23),
    "tool": (0.16, 0.05, 0.2),
    "board": (0.176, 0.006, 0.24),
}
"""Width, thickness between the fingers, and length of a thing at its full size, metres."""
SQUARES = Board("charuco", 0.032, 5, 7, 0.024, "4X4_50")
"""The ChArUco board at its full size."""
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
_TIPS_M = 0.112
_SAMPLES = 4
_NOISE = 0.012
_ARM_SIGMA = np.repeat([1e-4, np.deg2rad(0.02)], 3)


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
    joints_rad: Array
    """(images, 7)."""
    scale: float
    """Size of the thing in parts of `SIZES_M`."""


def render(setting: Setting, out: Path) -> Iterator[int]:
    """Render the missing images of a recording, yielding the number of each, then write its poses.

    Raises:
        InputError: The seed is reserved, or the room has no place for such a camera.
    """
    import cv2

    root = out / setting.name
    folder = out / setting.name / "recording"
    if _finished(root) >= setting.images:
        return
    plan = make_plan(setting)
    half = setting.images // 2
    things = [] if setting.fault == "bare" else thing_parts(setting, plan.scale)
    opening = SIZES_M[setting.thing][1] * plan.scale / 2
    people = _people(setting) if setting.fault == "people" else []
    folder.mkdir(parents=True, exist_ok=True)
    renderer = None
    state = plan.room
    for i in range(setting.images):
        path = folder / f"{i:03d}.png"
        if path.exists():
            continue
        moving = panda_meshes(plan.joints_rad[i], opening)
        moving += _moved(
            things, (plan.base_from_gripper @ plan.gripper_from_thing)[i].matrix()
        )
        for k, person in enumerate(people):
            moving += _moved(person, _walk(plan, [setting.seed, i, k]))
        if setting.fault == "change" and i >= half and state is plan.room:
            state = rearranged(plan.room, setting.seed)
            renderer = None
        if renderer is None:
            renderer = Renderer(state.meshes() + moving)
        else:
            renderer.move({mesh.name: mesh for mesh, _ in moving})
        options = RenderOptions(samples=_SAMPLES, noise=_NOISE)
        seed = int(np.random.default_rng([setting.seed, i, setting.px]).integers(2**31))
        rgb = renderer.render(plan.camera, plan.base_from_camera[i], options, seed)
        write_bytes(path, cv2.imencode(".png", rgb[..., ::-1])[1].tobytes())
        yield i
    rng = np.random.default_rng([setting.seed, 23])
    noise = SE3.exp(rng.normal(0, _ARM_SIGMA, (setting.images, 6)))
    write_poses(folder, plan.base_from_gripper @ noise)
    camera = asdict(plan.camera)
    write_json(
        folder / "camera.json", {k: camera[k] for k in camera if k != "distortion"}
    )
    write_json(root / "truth.json", _truth(setting, plan))


def _finished(root: Path) -> int:
    file = root / "truth.json"
    return json.loads(file.read_text())["images"] if file.exists() else 0


def write_poses(folder: Path, base_from_gripper: SE3) -> None:
    """Write the pose file of a recording with images 000.png, 001.png, ..."""
    numbers = np.c_[base_from_gripper.translation_m, base_from_gripper.rotation_wxyz]
    lines = [
        f"{i:03d}.png," + ",".join(f"{x:.9f}" for x in row)
        for i, row in enumerate(numbers)
    ]
    text = "\n".join(["image,x,y,z,qw,qx,qy,qz", *lines, ""])
    write_bytes(folder / "base_from_gripper.csv", text.encode())


def _truth(setting: Setting, plan: Plan) -> dict[str, object]:
    poses = {
        "base_from_camera": plan.base_from_camera,
        "base_from_gripper": plan.base_from_gripper,
        "gripper_from_thing": plan.gripper_from_thing,
    }
    return {
        **asdict(setting),
        "room": plan.room.kind,
        "scale": plan.scale,
        "joints_rad": plan.joints_rad.tolist(),
        **{name: [pose_to_dict(pose) for pose in each] for name, each in poses.items()},
    }


def make_plan(setting: Setting) -> Plan:
    """Choose the room, the camera, and arm poses that show the thing's front to the camera."""
    if not 0 <= setting.seed < RESERVED or setting.fault not in ("", *FAULTS):
        raise InputError(
            f"seed {setting.seed}, fault {setting.fault!r}: not a recording"
        )
    width, height = setting.size
    scene = room(sorted(KINDS)[setting.seed % len(KINDS)], setting.seed)
    for attempt in range(60):
        rng = np.random.default_rng([setting.seed, attempt, 21])
        focal = width * rng.uniform(0.85, 1.15) * (1.0 if width < 1000 else 0.9)
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
            continue
        aside = (0.42 if setting.fault == "out" else 0.08) * distance * width / focal
        aim = middle + aside * rng.choice([-1, 1]) * np.cross(towards, [0.0, 0, 1])
        pose = look_at(
            eye, aim + rng.uniform(-0.1, 0.1, 3) * distance / 3, rng.uniform(-0.1, 0.1)
        )
        gripper_from_thing = _grip(setting, scale, rng)
        facing = np.arctan2(towards[1], towards[0]) + rng.uniform(-0.35, 0.35)
        poses = _arm_poses(
            setting, camera, pose, middle, facing, gripper_from_thing, scale, rng
        )
        if poses is not None:
            joints = np.stack(poses)[: setting.images]
            grippers = SE3.stack([base_from_flange(angles) for angles in joints])
            cameras = SE3.stack([pose] * len(joints))
            grips = [gripper_from_thing] * len(joints)
            plan = Plan(
                scene, camera, cameras, grippers, SE3.stack(grips), joints, scale
            )
            return _with_break(setting, plan, rng)
    raise InputError(f"seed {setting.seed}: no place for a camera; use another seed")


def _grip(setting: Setting, scale: float, rng: Generator) -> SE3:
    """gripper_from_thing; the fingers close along the thing's y."""
    length = SIZES_M[setting.thing][2] * scale
    hand = SE3.exp([0, 0, _TIPS_M - _GRIPPED_M * scale + length / 2, 0, 0, 0])
    hand = SE3.exp([0, 0, 0, 0, 0, -np.pi / 4]) @ hand
    tilt = rng.uniform(-1, 1, 3) * np.deg2rad((2.0, 12.0, 2.0))
    return hand @ SE3.exp([*rng.uniform(-0.01, 0.01, 3), *tilt])


def _arm_poses(
    setting: Setting,
    camera: Camera,
    base_from_camera: SE3,
    middle: Array,
    facing: float,
    gripper_from_thing: SE3,
    scale: float,
    rng: Generator,
) -> list[Array] | None:
    """Joint angles of each image, or None where the arm reaches too few poses."""
    # z of the thing points down and its front, y, to the camera.
    y = np.array([np.cos(facing), np.sin(facing), 0.0])
    z = np.array([0.0, 0.0, -1.0])
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([np.cross(y, z), y, z], -1)
    upright = SE3.from_matrix(matrix)
    sides = np.array(SIZES_M[setting.thing]) * scale
    corners = (np.indices((2, 2, 2)).reshape(3, -1).T - 0.5) * sides
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    found = []
    start = HOME_RAD
    for _ in range(8 * MOST_IMAGES):
        turn = np.deg2rad(TURN_DEG) * rng.uniform(-1, 1, 3)
        turn = {"still": 0.04 * turn, "axis": axis * turn[0]}.get(setting.fault, turn)
        place = middle + 0.35 * sides[2] * rng.uniform(-1, 1, 3)
        thing = SE3.from_translation(place) @ upright @ SE3.exp([0, 0, 0, *turn])
        seen = base_from_camera.inverse().apply(thing.apply(corners))
        pixels = camera.project(seen)
        if setting.fault != "out" and not camera_holds(camera, pixels):
            continue
        try:
            joints = joints_for(thing @ gripper_from_thing.inverse(), start, len(found))
        except InputError:
            if len(found) == 0 and _ > 10:
                return None
            continue
        frames = joint_frames(joints)[1:, :3, 3]
        apart = np.linalg.norm(frames - base_from_camera.translation_m, axis=1).min()
        if frames[:, 2].min() > 0.1 and apart > 0.2:
            found = [*found, joints]
            start = joints
        if len(found) == MOST_IMAGES:
            return found
    return None


def camera_holds(camera: Camera, pixels: Array) -> bool:
    """Whether pixels (n, 2) are at least 4 px inside the image."""
    high = (camera.width - 5, camera.height - 5)
    return bool(((pixels >= 4) & (pixels <= high)).all())


def _with_break(setting: Setting, plan: Plan, rng: Generator) -> Plan:
    """Let the thing slip at a random image, or bump the camera half way."""
    n = setting.images
    signs = rng.choice([-1, 1], 6) * rng.dirichlet(np.ones(3), 2).ravel() ** 0.5
    if setting.fault == "slip":
        first = int(rng.integers(n // 4, 3 * n // 4 + 1))
        slip = signs * np.repeat(
            [rng.uniform(0.001, 0.01), np.deg2rad(rng.uniform(1, 3))], 3
        )
        steps = SE3.exp(np.where(np.arange(n)[:, None] < first, 0.0, slip))
        return replace(plan, gripper_from_thing=plan.gripper_from_thing @ steps)
    if setting.fault == "bump":
        bump = signs * np.repeat(
            [rng.uniform(0.005, 0.02), np.deg2rad(rng.uniform(0.5, 2))], 3
        )
        steps = SE3.exp(np.where(np.arange(n)[:, None] < n // 2, 0.0, bump))
        return replace(plan, base_from_camera=plan.base_from_camera @ steps)
    return plan


def thing_parts(setting: Setting, scale: float) -> Parts:
    """Meshes of the thing in its frame."""
    rng = np.random.default_rng([setting.seed, 22])
    x, y, z = SIZES_M[setting.thing]
    if setting.thing == "bottle":
        parts = _bottle(z, rng)
    elif setting.thing == "book":
        spine = spines("", rng).texture[:, :64]
        pages = np.full((256, 64, 3), (225, 218, 200), np.uint8)
        pages[:, ::3] -= np.uint8(14)
        pictures = [_print(rng, 600, 400), _print(rng, 600, 400, 12), spine, pages]
        parts = _carton((x, y, z), [*pictures, pages, pages])
    elif setting.thing == "board":
        page = np.full((480, 352), 250, np.uint8)
        page[16:464, 16:336] = board_image(SQUARES, 64)
        white = np.full((1, 1, 3), 235, np.uint8)
        parts = _carton((x, y, z), [np.repeat(page[..., None], 3, 2), *[white] * 5])
    elif setting.thing == "tool":
        parts = _tool(rng)
    else:
        sides = [_print(rng, 600, 400, leaves) for leaves in (None, 40)]
        sides += [_print(rng, 600, 150, 12) for _ in range(2)]
        parts = _carton(
            (x, y, z), [*sides, *(_print(rng, 150, 400, 8) for _ in range(2))]
        )
    dull = plain("dull", (0.72, 0.6, 0.45)).texture
    cell = np.tile(
        label("", tuple(rng.uniform(0.3, 0.8, 3)), rng).texture[::4, ::4], (5, 5, 1)
    )
    textures = {"smooth": dull, "repeats": cell}
    kind = "metal" if setting.fault == "shiny" else ""
    return [
        (
            replace(mesh.scaled(scale), uv=mesh.uv, name=f"thing{k}"),
            replace(
                material,
                name=f"thing{k}",
                texture=textures.get(setting.fault, material.texture),
                kind=kind or material.kind,
                roughness=0.06 if kind else material.roughness,
            ),
        )
        for k, (mesh, material) in enumerate(parts)
    ]


def _carton(size_m: tuple[float, float, float], pictures: list[Array]) -> Parts:
    """A box with pictures on its front and back (y), sides (x), and ends (z)."""
    parts = []
    half = np.array(size_m) / 2
    for k, (axis, up) in enumerate([(1, 2), (1, 2), (0, 2), (0, 2), (2, 1), (2, 1)]):
        normal = np.zeros(3)
        v = np.zeros(3)
        normal[axis] = 1 - 2 * (k % 2)
        v[up] = -1.0  # upright where the gripper is above
        u = np.cross(v, normal)
        corner = (normal - u - v) * half
        right = 2 * u * half
        top = 2 * v * half
        mesh = sheet(corner.tolist(), right.tolist(), top.tolist())
        parts.append((mesh, Material("", pictures[k], kind="coated", roughness=0.3)))
    return parts


def _print(rng: Generator, rows: int, columns: int, leaves: int | None = None) -> Array:
    """A printed page: a picture with a label on it."""
    import cv2

    page = dead_leaves(rows, columns, rng, leaves)
    side = min(rows, columns) * 3 // 5
    badge = label("", tuple(rng.uniform(0.1, 0.9, 3)), rng).texture
    top, left = (int(rng.integers(0, n - side)) for n in (rows, columns))
    badge = cv2.resize(badge, (side, side), interpolation=cv2.INTER_AREA)
    page[top : top + side, left : left + side] = badge
    return page


def _bottle(length: float, rng: Generator) -> Parts:
    """Glass with a printed label around it; its neck is in the gripper."""
    r = 0.03
    profile = []
    for radius, share in (
        (0, 0.0),
        (0.8, 0),
        (1, 0.03),
        (1, 0.62),
        (0.85, 0.72),
        (0.45, 0.82),
    ):
        profile.append((r * radius, length * share))
    body = lathe([*profile, (r * 0.42, length), (0, length)], 48, 1)
    middle = lathe([(r * 1.01, 0.08 * length), (r * 1.01, 0.6 * length)], 48, 1)
    glass = Material(
        "", _print(rng, 300, 256, 3) // 4 + np.uint8(40), 0.2, "coated", 0.1
    )
    paper = Material("", _print(rng, 420, 620), kind="coated", roughness=0.35)
    high = np.ptp(middle.uv, axis=0)
    middle = replace(middle, uv=middle.uv / high)
    turned = np.diag([1.0, -1.0, -1.0])  # its bottom is away from the gripper
    return [(mesh.shifted(0, 0, -length / 2).rotated(turned), material)
            for mesh, material in ((body, glass), (middle, paper))]  # fmt: skip


def _tool(rng: Generator) -> Parts:
    """A cordless drill: motor, handle in the gripper, battery."""
    tools = []
    for size, place in (
        ((0.05, 0.045, 0.11), (-0.02, 0, -0.045)),
        ((0.16, 0.05, 0.06), (0.0, 0, 0.07)),
        ((0.1, 0.05, 0.05), (-0.02, 0, 0.015)),
    ):
        x, y, z = (max(64, round(2500 * side)) for side in size)
        pictures = [_print(rng, z, x) for _ in range(2)] + [
            _print(rng, z, y) for _ in range(2)
        ]
        pictures += [_print(rng, y, x, 8) for _ in range(2)]
        tools += [
            (mesh.shifted(*place), material)
            for mesh, material in _carton(size, pictures)
        ]
    return tools


def _people(setting: Setting) -> list[Parts]:
    """Two persons: a patterned body with a head, feet at the origin."""
    rng = np.random.default_rng([setting.seed, 24])
    people = []
    for k in range(2):
        body = lathe(
            [(0, 0), (0.16, 0), (0.2, 0.9), (0.24, 1.35), (0.08, 1.5), (0, 1.5)], 24, 1
        )
        cloth = fabric(f"person{k}", tuple(rng.uniform(0.1, 0.8, 3)), rng)
        head = replace(ball(0.12).shifted(0, 0, 1.48), name=f"head{k}")
        skin = plain(head.name, (0.75, 0.55, 0.42))
        people.append([(replace(body, name=cloth.name), cloth), (head, skin)])
    return people


def _walk(plan: Plan, seed: list[int]) -> Array:
    """base_from_person: beyond the arm, in the camera's view."""
    rng = np.random.default_rng(seed)
    camera = plan.base_from_camera[0]
    ahead = camera.rotation_matrix()[:2, 2]
    ahead = ahead / np.linalg.norm(ahead)
    beyond = (
        plan.base_from_gripper.translation_m.mean(0)[:2] + rng.uniform(0.5, 1.4) * ahead
    )
    aside = rng.uniform(-0.6, 0.6) * np.array([-ahead[1], ahead[0]])
    matrix = SE3.exp([0, 0, 0, 0, 0, rng.uniform(-3, 3)]).matrix()
    matrix[:3, 3] = [*(beyond + aside), plan.room.low_m[2]]
    return matrix


def _moved(parts: Parts, matrix: Array) -> Parts:
    rotation = matrix[:3, :3]
    shift = matrix[:3, 3].tolist()
    return [(mesh.rotated(rotation, shift), material) for mesh, material in parts]
