"""What goes wrong with recordings of an arm in view, done to images, joint values and URDFs."""

import json
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.random import Generator

from evercal.geometry import SE3, Camera
from evercal.simulation.textures import dead_leaves
from evercal.storage import write_bytes, write_json
from rooms.arm_shapes import ArmShapes, Part
from rooms.arms import ARMS, urdf_of, write_joints
from rooms.drawn_arms import Stage, coverage, draw_beside
from rooms.shapes import box


@dataclass(eq=False)
class Cell:
    """A recording and its truth, to be spoiled."""

    images: list[np.ndarray]
    """BGR."""
    joints: np.ndarray
    """(n, k)."""
    camera: Camera
    urdf: str
    """Text of the URDF."""
    arm: str
    base_from_camera: list[SE3]
    """True poses, the second one of the last images."""


def read_cell(root: Path, n: int) -> Cell:
    """The first images of a recording of `rooms.arms`."""
    truth = json.loads((root / "truth.json").read_text())
    folder = root / "recording"
    files = [folder / f"{i:03d}.png" for i in range(n)]
    images = [np.asarray(cv2.imread(str(file))) for file in files]
    pose = truth["base_from_camera"]
    camera = Camera.from_dict(json.loads((folder / "camera.json").read_text()))
    return Cell(
        images,
        np.array(truth["joints"])[:n],
        camera,
        next(folder.glob("*.urdf")).read_text(),
        truth["arm"],
        [SE3(pose["quaternion_wxyz"], pose["translation_m"])],
    )


def write_cell(cell: Cell, folder: Path) -> None:
    """Write a recording."""
    folder.mkdir(parents=True)
    for i, image in enumerate(cell.images):
        write_bytes(folder / f"{i:03d}.png", cv2.imencode(".png", image)[1].tobytes())
    write_joints(folder, ARMS[cell.arm].joints, cell.joints)
    write_json(folder / "camera.json", cell.camera.to_dict())
    write_bytes(folder / "robot.urdf", cell.urdf.encode())


def spoil(cell: Cell, fault: str, size: float, rng: Generator) -> None:
    """Spoil a cell by one of `FAULTS` of a size."""
    FAULTS[fault](cell, size, rng)


def _half(cell: Cell, _: float, __: Generator) -> None:
    camera = cell.camera
    cell.camera = camera.resized(camera.width // 2, camera.height // 2)
    size = (cell.camera.width, cell.camera.height)
    area = cv2.INTER_AREA
    cell.images = [cv2.resize(image, size, interpolation=area) for image in cell.images]


def _joints(cell: Cell, deg: float, rng: Generator) -> None:
    """Offsets of all joints but the first, whose zero is the base's."""
    names = ARMS[cell.arm].joints
    slides = [name == "slide" or "finger" in name for name in names]
    offsets = np.deg2rad(deg) * rng.normal(size=len(names))
    offsets[0] = 0
    cell.joints = cell.joints + np.where(slides, 0.0, offsets)


def _shuffled(cell: Cell, _: float, rng: Generator) -> None:
    cell.joints = cell.joints[rng.permutation(len(cell.joints))]


def _shifted(cell: Cell, rows: float, _: Generator) -> None:
    cell.joints = np.roll(cell.joints, int(rows), axis=0)


def _focal(cell: Cell, share: float, rng: Generator) -> None:
    factor = 1 + share * rng.choice([-1, 1])
    camera = cell.camera.to_dict()
    camera |= {"fx": factor * cell.camera.fx, "fy": factor * cell.camera.fy}
    cell.camera = Camera.from_dict(camera)


def _moved_meshes(cell: Cell, mm: float, rng: Generator) -> None:
    root = ET.fromstring(cell.urdf)
    for link in root.findall("link"):
        step = rng.normal(size=3)
        step *= mm / 1000 / np.linalg.norm(step)
        for visual in link.findall("visual"):
            origin = visual.find("origin")
            if origin is None:
                origin = ET.SubElement(visual, "origin")
            xyz = np.array(origin.get("xyz", "0 0 0").split(), float) + step
            origin.set("xyz", " ".join(map(str, xyz)))
    cell.urdf = ET.tostring(root, encoding="unicode")


def _scaled_meshes(cell: Cell, share: float, _: Generator) -> None:
    root = ET.fromstring(cell.urdf)
    for shape in root.findall("link/visual/geometry/*"):
        if shape.tag == "mesh":
            shape.set("scale", shape.get("scale", "1 1 1"))
        for key in ("scale", "size", "radius", "length"):
            if key in shape.attrib:
                numbers = np.array(shape.attrib[key].split(), float) * (1 + share)
                shape.set(key, " ".join(map(str, numbers)))
    cell.urdf = ET.tostring(root, encoding="unicode")


def _other_robot(cell: Cell, _: float, __: Generator) -> None:
    """The meshes of a second arm on the joints of the first."""
    other = "ur5" if cell.arm != "ur5" else "xarm7"
    files = re.findall(r'[^"]*visual/[^"]*', urdf_of(other).read_text())
    meshes = iter(files * 20)
    root = ET.fromstring(cell.urdf)
    robots = urdf_of(other).parents[4]
    for shape in root.findall("link/visual/geometry"):
        shape.clear()
        name = next(meshes).replace("package://", f"{robots}/")
        ET.SubElement(shape, "mesh", filename=name)
    cell.urdf = ET.tostring(root, encoding="unicode")


def _bump(cell: Cell, px: float, rng: Generator) -> None:
    axis = rng.normal(size=3) * (1, 1, 0.3)
    axis *= px / cell.camera.fx / np.linalg.norm(axis)
    turn = SE3.exp([0, 0, 0, *axis])
    matrix = cell.camera.matrix()
    warp = matrix @ turn.rotation_matrix().T @ np.linalg.inv(matrix)
    size = (cell.camera.width, cell.camera.height)
    for i in range(len(cell.images) // 2, len(cell.images)):
        cell.images[i] = cv2.warpPerspective(
            cell.images[i], warp, size, borderMode=cv2.BORDER_REFLECT
        )
    cell.base_from_camera.append(cell.base_from_camera[0] @ turn)


def _light(cell: Cell, size: float, rng: Generator) -> None:
    for i, image in enumerate(cell.images):
        gain, gamma = np.exp(size * rng.uniform(-1, 1, 2) * (1, 0.5))
        changed = 255 * gain * (image / 255.0) ** gamma
        cell.images[i] = changed.clip(0, 255).astype(np.uint8)


def _people(cell: Cell, share: float, rng: Generator) -> None:
    """Somebody behind the arm, at another place in each image; in few images before it."""
    height, width = cell.images[0].shape[:2]
    cloth = dead_leaves(height, width, rng)[..., ::-1]
    covers = [*_covers(cell)]
    for i, image in enumerate(cell.images):
        if rng.uniform() > share:
            continue
        x, top = rng.uniform((0.1, 0.1), (0.9, 0.4)) * (width, height)
        half = rng.uniform(0.06, 0.11) * width
        body = np.zeros((height, width), np.float32)
        centre = (int(x), int(top + 0.6 * height))
        axes = (int(half), int(0.5 * height))
        cv2.ellipse(body, centre, axes, 0, 0, 360, 1.0, -1, cv2.LINE_AA)
        head = (int(x), int(top))
        cv2.circle(body, head, int(0.6 * half), 1.0, -1, cv2.LINE_AA)
        if rng.uniform() < 0.85:
            body *= 1 - covers[i]
        body = body[..., None]
        cell.images[i] = (body * cloth + (1 - body) * image).round().astype(np.uint8)


def _tool(cell: Cell, size: float, rng: Generator) -> None:
    """A box at the end of the arm that the URDF lacks."""
    kind = ARMS[cell.arm]
    mesh = box(*(size * rng.uniform((0.4, 0.4, 0.8), (0.8, 0.8, 1.2))).tolist())
    shapes = ArmShapes(urdf_of(cell.arm), kind.joints)
    last = [part for part in shapes.parts if "finger" not in part.link][-1]
    ahead = last.vertices_m[np.linalg.norm(last.vertices_m, axis=1).argmax()]
    place = mesh.vertices_m - mesh.vertices_m.mean(0) + ahead
    tint = tuple(rng.uniform(0.05, 0.6, 3).tolist())
    tool = Part(last.link, place, mesh.normals, mesh.faces.astype(np.int32), tint)
    stage = _empty_stage(cell)
    for i, image in enumerate(cell.images):
        drawn = draw_beside(image[..., ::-1], shapes, cell.joints[i], tool, stage)
        cell.images[i] = drawn[..., ::-1]


def _covers(cell: Cell) -> Iterator[np.ndarray]:
    shapes = ArmShapes(urdf_of(cell.arm), ARMS[cell.arm].joints)
    stage = _empty_stage(cell)
    for joints in cell.joints:
        yield coverage(shapes, joints, stage)


def _empty_stage(cell: Cell) -> Stage:
    depth = np.zeros(cell.images[0].shape[:2], np.float32)
    light = np.array([0.5, 0.5, 1.5])
    return Stage(cell.camera, cell.base_from_camera[0], cell.images[0], depth, light)


FAULTS = {
    "half": _half,
    "joints": _joints,
    "shuffled": _shuffled,
    "shifted": _shifted,
    "focal": _focal,
    "mesh": _moved_meshes,
    "scale": _scaled_meshes,
    "robot": _other_robot,
    "bump": _bump,
    "light": _light,
    "people": _people,
    "tool": _tool,
}
"""Functions that spoil a `Cell` by a size: degrees, millimetres, shares, pixels."""
