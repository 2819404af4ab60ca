"""Coloured visual meshes of a URDF's links, for pictures of an arm."""

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh  # pyright: ignore[reportMissingImports]
from scipy.spatial.transform import Rotation

from evercal.robot.robot_model import RobotModel
from rooms.panda import robots_folder


@dataclass(frozen=True, eq=False)
class Part:
    """One visual mesh in the frame of its link."""

    link: str
    vertices_m: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    colour: tuple[float, ...]
    """Share of light that is reflected, linear RGB."""


class ArmShapes:
    """Meshes and kinematics of a URDF whose joint values are in the order of `joints`."""

    def __init__(self, urdf: Path, joints: tuple[str, ...]) -> None:
        self.joints = joints
        self._model = RobotModel(urdf)
        root = ET.fromstring(urdf.read_text())
        colours = {
            item.get("name"): _rgb(item.find("color").get("rgba"))  # pyright: ignore
            for item in root.findall("material")
            if item.find("color") is not None
        }
        self.parts: list[Part] = []
        for link in root.findall("link"):
            for visual in link.findall("visual"):
                self.parts += _parts(link.get("name", ""), visual, colours)
        names = dict.fromkeys(part.link for part in self.parts)
        base = self._model.base_link
        self._arms = {link: self._model.arm(base, link) for link in names}

    def frames(self, joints: np.ndarray) -> dict[str, np.ndarray]:
        """(4, 4) base_from_link of each link with a mesh, for values (k,)."""
        given = dict(zip(self.joints, joints, strict=True))
        frames = {}
        for link, arm in self._arms.items():
            values = np.array([[given.get(name, 0.0) for name in arm.joints]])
            frames[link] = arm.poses(values).matrix()[0]
        return frames


def _parts(link: str, visual: ET.Element, colours: dict) -> list[Part]:
    origin = visual.find("origin")
    matrix = np.eye(4)
    if origin is not None:
        angles = _numbers(origin.get("rpy", "0 0 0"))
        matrix[:3, :3] = Rotation.from_euler("xyz", angles).as_matrix()
        matrix[:3, 3] = _numbers(origin.get("xyz", "0 0 0"))
    material = visual.find("material")
    stated = (0.6, 0.6, 0.62)
    if material is not None:
        stated = colours.get(material.get("name"), stated)
        colour = material.find("color")
        if colour is not None:
            stated = _rgb(colour.get("rgba", ""))
    parts = []
    shape = visual.find("geometry")[0]  # pyright: ignore[reportOptionalSubscript]
    for mesh, colour in _meshes(shape):
        mesh.apply_transform(matrix)
        vertices = np.array(mesh.vertices, float)
        normals = np.array(mesh.vertex_normals, float)
        faces = np.array(mesh.faces, np.int32)
        parts.append(Part(link, vertices, normals, faces, colour or stated))
    return parts


def _meshes(shape: ET.Element) -> list[tuple[trimesh.Trimesh, tuple | None]]:
    if shape.tag == "box":
        mesh = trimesh.creation.box(_numbers(shape.get("size", "")))
        mesh.unmerge_vertices()
        return [(mesh, None)]
    if shape.tag == "cylinder":
        sizes = [float(shape.get(key, "")) for key in ("radius", "length")]
        mesh = trimesh.creation.cylinder(*sizes, sections=48)
        return [(trimesh.graph.smooth_shade(mesh, angle=0.6), None)]
    name = shape.get("filename", "").removeprefix(
        "package://example-robot-data/robots/"
    )
    scene = trimesh.load_scene(robots_folder() / name)
    found = []
    for node in scene.graph.nodes_geometry:
        matrix, key = scene.graph[node]
        mesh = scene.geometry[key].copy()
        mesh.apply_transform(matrix)
        mesh.apply_scale(_numbers(shape.get("scale", "1 1 1")))
        colour = None
        if name.endswith(".dae"):
            srgb = np.asarray(mesh.visual.material.main_color, float)[:3] / 255
            colour = tuple((srgb**2.2).clip(0.02, 0.8).tolist())
        else:
            mesh.merge_vertices()
            mesh = trimesh.graph.smooth_shade(mesh, angle=0.6)
        found.append((mesh, colour))
    return found


def _numbers(text: str) -> list[float]:
    return [float(word) for word in text.split()]


def _rgb(text: str) -> tuple[float, ...]:
    return tuple((np.array(_numbers(text))[:3] ** 2.2).clip(0.02, 0.8).tolist())
