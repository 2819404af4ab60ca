"""The Franka Panda with its hand: meshes that follow the joint angles.

The meshes (Apache-2.0, from franka_ros) come with the package `example-robot-data`. Their frames
are those of `evercal.simulation.panda_arm.joint_frames`.
"""

import sys
from functools import lru_cache
from pathlib import Path

import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.simulation.panda_arm import joint_frames
from rooms.items import Parts
from rooms.materials import Material, plain
from rooms.shapes import Mesh

_ROBOTS = "share/example-robot-data/robots"


def panda_meshes(joints_rad: np.ndarray, opening_m: float = 0.03) -> Parts:
    """Meshes of the arm in the base frame, one named mesh for each colour.

    Args:
        joints_rad: Joint angles, shape (7,).
        opening_m: Way of each finger from the middle.

    Raises:
        InputError: The robot's meshes or the packages that read them are not installed.
    """
    frames = joint_frames(np.asarray(joints_rad, float))
    hand = frames[7] @ SE3.exp([0, 0, 0, 0, 0, -np.pi / 4]).matrix()
    places = {f"link{i}": [frame] for i, frame in enumerate([np.eye(4), *frames[:7]])}
    places |= {
        "hand": [hand],
        "finger": [hand @ finger for finger in _fingers(opening_m)],
    }
    groups: dict[str, tuple[Material, list[Mesh]]] = {}
    for link, matrices in places.items():
        for matrix in matrices:
            for mesh, material in _link_meshes(link):
                moved = mesh.transformed(matrix)
                groups.setdefault(material.name, (material, []))[1].append(moved)
    return [(Mesh.merged(group), material) for material, group in groups.values()]


def _fingers(opening_m: float) -> list[np.ndarray]:
    """hand_from_finger of both fingers; the second one is the first one turned about z."""
    left = SE3.from_translation((0, opening_m, 0.0584))
    return [left.matrix(), (SE3.exp([0, 0, 0, 0, 0, np.pi]) @ left).matrix()]


_MATERIALS = {
    "pale": plain("arm_pale", (0.88, 0.89, 0.9), "coated", 0.15),
    "black": plain("arm_black", (0.17, 0.17, 0.18), "coated", 0.25),
    "mark": plain("arm_mark", (0.1, 0.4, 0.65), "coated", 0.2),
}


@lru_cache
def _link_meshes(link: str) -> Parts:
    """Meshes of one link in its frame."""
    try:
        import collada  # noqa: F401  # pyright: ignore[reportMissingImports]
        import trimesh  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise InputError(_missing(error.name)) from None
    folder = robots_folder() / "panda_description/meshes/visual"
    scene = trimesh.load_scene(folder / f"{link}.dae")
    parts = []
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        shape = scene.geometry[name]
        colour = np.asarray(shape.visual.material.main_color, float)[:3] / 255
        tone = (
            "pale" if colour.min() > 0.85 else "black" if colour.max() < 0.4 else "mark"
        )
        vertices = np.array(shape.vertices, float)
        normals = np.array(shape.vertex_normals, float)
        faces = np.array(shape.faces)
        uv = np.zeros((len(vertices), 2))
        mesh = Mesh(vertices, faces, normals, uv, f"arm_{tone}")
        mesh = mesh.transformed(matrix)
        parts.append((mesh, _MATERIALS[tone]))
    return parts


def robots_folder() -> Path:
    """Folder of the robots of the package `example-robot-data`."""
    for entry in sys.path:
        for prefix in ("cmeel.prefix", "."):
            folder = Path(entry) / prefix / _ROBOTS
            if folder.is_dir():
                return folder
    raise InputError(_missing("example-robot-data"))


def _missing(package: str | None) -> str:
    return (
        f"the arm needs {package}, which is not installed; run: python -m pip install"
        " -c constraints.txt example-robot-data pycollada trimesh"
    )
