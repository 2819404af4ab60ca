"""The Franka Panda: forward kinematics and meshes.

URDF and meshes (Apache-2.0, from franka_ros) come with the package `example-robot-data`; yourdfpy
computes the forward kinematics.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.simulation.furnished.materials import Material, plain
from evercal.simulation.furnished.shapes import Mesh

FLANGE = "panda_link8"
"""The gripper frame: the flange that carries the hand."""

HOME_RAD = (0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785)
"""Franka's ready position."""

_FOLDER = "share/example-robot-data/robots/panda_description"


class Panda:
    """An arm with its hand.

    Raises:
        InputError: The extra `sim` is not installed.
    """

    def __init__(self, meshes: bool = True) -> None:
        try:
            import yourdfpy  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise InputError(
                "the robot needs yourdfpy, which is not installed; run: pip install 'evercal[sim]'"
            ) from None
        folder = _description()

        def on_disk(fname: str) -> str:
            return str(folder / fname.rpartition("panda_description/")[2])

        self._urdf: Any = yourdfpy.URDF.load(
            str(folder / "urdf" / "panda.urdf"), filename_handler=on_disk, load_meshes=meshes
        )
        self._parts = self._read_meshes() if meshes else []

    def base_from_flange(self, joints_rad: np.ndarray) -> SE3:
        """Pose of the flange for joint angles of shape (7,)."""
        self._configure(joints_rad)
        return SE3.from_matrix(self._urdf.get_transform(FLANGE, self._urdf.base_link))

    def meshes(self, joints_rad: np.ndarray) -> list[tuple[Mesh, Material]]:
        """Meshes of the arm for joint angles of shape (7,), one named mesh per colour."""
        self._configure(joints_rad)
        groups: dict[str, tuple[Material, list[Mesh]]] = {}
        for node, mesh, material in self._parts:
            matrix = np.asarray(self._urdf.scene.graph.get(node)[0], float)
            rotated = mesh.rotated(matrix[:3, :3], matrix[:3, 3].tolist())
            groups.setdefault(material.name, (material, []))[1].append(rotated)
        return [(Mesh.merged(group), material) for material, group in groups.values()]

    def _configure(self, joints_rad: np.ndarray) -> None:
        joints = np.asarray(joints_rad, float)
        if joints.shape != (7,):
            raise ValueError(f"a Panda takes 7 joint angles, got {joints.shape}")
        self._urdf.update_cfg(np.append(joints, 0.03))  # finger opening, metres

    def _read_meshes(self) -> list[tuple[str, Mesh, Material]]:
        scene, parts = self._urdf.scene, []
        for node in scene.graph.nodes_geometry:
            shape = scene.geometry[scene.graph[node][1]]
            colour = np.asarray(shape.visual.material.main_color, float)[:3] / 255
            tone = "pale" if colour.min() > 0.85 else "black" if colour.max() < 0.4 else "mark"
            vertices, normals = (
                np.array(shape.vertices, float),
                np.array(shape.vertex_normals, float),
            )
            uv = np.zeros((len(vertices), 2))
            mesh = Mesh(vertices, np.array(shape.faces), normals, uv, f"arm_{tone}")
            parts.append((node, mesh, _MATERIALS[tone]))
        return parts


_MATERIALS = {
    "pale": plain("arm_pale", (0.88, 0.89, 0.9), "coated", 0.15),
    "black": plain("arm_black", (0.17, 0.17, 0.18), "coated", 0.25),
    "mark": plain("arm_mark", (0.1, 0.4, 0.65), "coated", 0.2),
}


def _description() -> Path:
    for entry in sys.path:
        for prefix in ("cmeel.prefix", "."):
            folder = Path(entry) / prefix / _FOLDER
            if (folder / "urdf" / "panda.urdf").is_file():
                return folder
    raise InputError(
        "the robot's meshes (package example-robot-data) are not installed; run:"
        " pip install 'evercal[sim]'"
    )
