"""`robot_body`: the surfaces of a robot's links, from the visual geometry of its URDF."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from evercal.bounds import require_at_most
from evercal.classes import frozen_arrays
from evercal.errors import InputError, optional_module
from evercal.robot.arm import Arm
from evercal.robot.meshes import Triangles, joined, merged, mesh_file, read_mesh
from evercal.robot.robot_model import RobotModel
from evercal.robot.urdf import Geometry, stated_geometry
from evercal.storage.text_files import few, named_errors, naming
from evercal.typing import Array, IntArray, Strings

_SAME_M = 1e-5
"""Vertices so near are one."""
_LARGEST_M = 20.0
"""No link is larger; a finger in millimetres is."""


@frozen_arrays
class LinkShape:
    """The surface of a link."""

    link: str
    vertices: Array
    """(n, 3) metres, in the link's frame."""
    faces: IntArray
    """(m, 3) vertices of each triangle, counterclockwise as seen from outside."""


@frozen_arrays
class RobotBody:
    """Surfaces of a robot and how they move."""

    base: str
    """The link in whose frame poses are."""
    joints: Strings
    """Names of the k joint values."""
    links: tuple[LinkShape, ...]
    """Links with a surface."""
    arms: tuple[Arm, ...]
    """Chain from the base to each of them."""
    notes: Strings
    """Joints without values and links without visual geometry."""

    def frames(self, values: Array) -> Array:
        """(links, n, 4, 4) base_from_link of joint values (n, k), radians or metres."""
        frames = []
        for arm in self.arms:
            moved = np.tile(_rest(arm), (len(values), 1))
            for column, name in enumerate(arm.joints):
                if name in self.joints:
                    moved[:, column] = values[:, self.joints.index(name)]
            frames.append(arm.poses(moved).matrix())
        return np.stack(frames)


def robot_body(
    model: RobotModel,
    joints: Sequence[str],
    base: str | None = None,
    without: Sequence[str] = (),
) -> RobotBody:
    """Surfaces of all links that are connected to a link, its base.

    Args:
        model: The robot; its mesh files are read.
        joints: Names of the values that will be given. Others stand at 0, or in the middle of
            their limits.
        base: A link; if omitted, the root.
        without: Links to leave out.
    """
    base = base or model.base_link
    unknown = [link for link in (base, *without) if link not in model.links]
    if unknown:
        raise InputError(
            f"{model.path}: has no link {few(unknown, model.links)}; it has"
            f" {', '.join(model.links)}"
        )
    with named_errors(model.path, "URDF or a mesh of it"):
        geometry = stated_geometry(model.path.read_bytes())
        chosen, notes = _chosen(geometry, without)
        links = _shapes(model, chosen)
    if not links:
        raise InputError(f"{model.path}: no link has geometry, so images show none")
    arms = [model.arm(base, link.link) for link in links]
    valueless = {
        f"{name} at {value:.3g}": None
        for arm in arms
        for name, value in zip(arm.joints, _rest(arm), strict=True)
        if name not in joints
    }
    if valueless:
        notes.append(f"joints without values stand still: {', '.join(valueless)}")
    return RobotBody(base, tuple(joints), tuple(links), tuple(arms), tuple(notes))


def _rest(arm: Arm) -> Array:
    """(k,) zero, or the middle of the limits that exclude it."""
    lower, middle, upper = np.broadcast_to(arm.ranges, (len(arm.joints), 3)).T
    return np.where((lower <= 0) & (upper >= 0), 0.0, middle)


def _chosen(
    geometry: Sequence[Geometry], without: Sequence[str]
) -> tuple[dict[str, list[Geometry]], list[str]]:
    """Visual geometry by link, of links without it the collision geometry, and notes."""
    kinds: dict[str, dict[str, list[Geometry]]] = {}
    notes = []
    for part in geometry:
        if part.link in without:
            continue
        if not part.shape:
            notes.append(
                f"link {part.link}: {part.kind} geometry that is no mesh, box, cylinder or sphere"
                " is left out"
            )
            continue
        kinds.setdefault(part.link, {}).setdefault(part.kind, []).append(part)
    chosen = {}
    lacking = []
    for link, of_link in kinds.items():
        chosen[link] = of_link.get("visual") or of_link["collision"]
        if "visual" not in of_link:
            lacking.append(link)
    if lacking:
        notes.append(
            f"collision geometry stands for visual geometry of {', '.join(lacking)}"
        )
    return chosen, notes


def _shapes(model: RobotModel, chosen: dict[str, list[Geometry]]) -> list[LinkShape]:
    shapes = []
    size_bytes = faces = 0
    for link, parts in chosen.items():
        surfaces = []
        for part in parts:
            with naming(f"link {link}"):
                file = None
                if part.shape == "mesh":
                    file = mesh_file(model.path, part.file)
                    size_bytes += file.stat().st_size
                    require_at_most(size_bytes, "mesh_bytes", "bytes of meshes")
                surfaces.append(_surface(part, file))
                faces += len(surfaces[-1].faces)
                require_at_most(faces, "faces", "triangles of meshes")
        mesh = merged(joined(surfaces), _SAME_M)
        if not len(mesh.faces):
            continue
        size = np.ptp(mesh.vertices, axis=0).max()
        if size > _LARGEST_M:
            raise ValueError(
                f"link {link}: is {size:.4g} m large; lengths of a URDF are metres; give meshes in"
                ' millimetres scale="0.001 0.001 0.001"'
            )
        shapes.append(LinkShape(link, *mesh))
    return shapes


def _surface(part: Geometry, file: Path | None) -> Triangles:
    if file is None:
        vertices, faces = _primitive(part)
    else:
        vertices, faces = read_mesh(file)
        vertices = vertices * part.sizes
        if np.prod(part.sizes) < 0:
            faces = faces[:, ::-1]
    turned = Rotation.from_euler("xyz", part.rpy).as_matrix()
    return Triangles(vertices @ turned.T + part.xyz, faces)


def _primitive(part: Geometry) -> Triangles:
    creation = optional_module("trimesh.creation", "geometry needs trimesh", "urdf")
    if part.shape == "box":
        mesh = creation.box(part.sizes)
    elif part.shape == "cylinder":
        mesh = creation.cylinder(*part.sizes, sections=64)
    else:
        mesh = creation.icosphere(4, *part.sizes)
    return Triangles(np.array(mesh.vertices), np.array(mesh.faces, np.int64))
