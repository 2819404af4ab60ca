"""`robot_body`: the surfaces of a robot's links, from the geometry of its URDF."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Self

import numpy as np
from scipy.spatial.transform import Rotation

from evercal.bounds import require_at_most
from evercal.classes import frozen_arrays
from evercal.errors import InputError, optional_module
from evercal.robot.arm import Arm
from evercal.robot.meshes import merged, mesh_file, read_mesh
from evercal.robot.robot_model import RobotModel
from evercal.robot.urdf import Geometry, stated_geometry
from evercal.storage.text_files import few, named_errors, naming
from evercal.typing import Array, IntArray, Strings

_SAME_M = 1e-5
"""Vertices so near are one."""
_MANY = 20_000
"""Links of more triangles are simplified."""
_CELL_M = 0.001
"""Cell in which their vertices become one: it moves 99 % of the surface by less than 0.3 mm."""
_LARGEST_M = 20.0
"""No link is larger, and most are in millimetres."""


@frozen_arrays
class LinkShape:
    """The surface of a link."""

    link: str
    vertices: Array
    """(n, 3) metres, in the link's frame."""
    faces: IntArray
    """(m, 3) vertices of each triangle, counterclockwise as seen from outside."""

    def simplified(self, cell_m: float) -> Self:
        """The surface with one vertex for those in each cell of a grid."""
        vertices, faces = merged(self.vertices[self.faces], cell_m)
        return replace(self, vertices=vertices, faces=faces)


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

    def frames(self, values: Array) -> Array:
        """(links, n, 4, 4) base_from_link of joint values (n, k), radians or metres."""
        return np.stack(
            [arm.poses(self.values_of(arm, values)).matrix() for arm in self.arms]
        )

    def slopes(self, values: Array) -> Array:
        """(links, n, 6, k) motion of links by each value: translation, rotation; axes of links."""
        slopes = np.zeros((len(self.arms), len(values), 6, len(self.joints)))
        for number, arm in enumerate(self.arms):
            own = arm.slopes(self.values_of(arm, values))
            for column, name in enumerate(arm.joints):
                if name in self.joints:
                    slopes[number, ..., self.joints.index(name)] = own[..., column]
        return slopes

    def values_of(self, arm: Arm, values: Array) -> Array:
        """(n, j) values of the joints of a chain; those without values stand at rest."""
        moved = np.tile(_rest(arm), (len(values), 1))
        for column, name in enumerate(arm.joints):
            if name in self.joints:
                moved[:, column] = values[:, self.joints.index(name)]
        return moved


def robot_body(
    model: RobotModel,
    joints: Sequence[str],
    base: str | None = None,
    without: Sequence[str] = (),
) -> RobotBody:
    """Surfaces of all links: their visual geometry, or the collision geometry of a robot without.

    Links of other robots often have collision geometry alone to keep a distance.

    Args:
        model: The robot; its mesh files are read.
        joints: Names of the values that will be given. Others stand at 0, or in the middle of
            their limits.
        base: A link; if omitted, the root.
        without: Links to leave out.
    """
    base = base or model.base_link
    unknown = [link for link in without if link not in model.links]
    if unknown:
        raise InputError(f"{model.path}: has no link {few(unknown, model.links)}")
    with named_errors(model.path, "mesh or URDF"):
        geometry = stated_geometry(model.path.read_bytes())
        shown = [part for part in geometry if part.kind == "visual"]
        shown = shown or geometry
        links = _links(model.path, [part for part in shown if part.link not in without])
    if not links:
        raise InputError(f"{model.path}: no link has geometry, so images show none")
    arms = tuple(model.arm(base, link.link) for link in links)
    return RobotBody(base, tuple(joints), tuple(links), arms)


def _rest(arm: Arm) -> Array:
    """(k,) zero, or the middle of the limits that exclude it."""
    lower, middle, upper = np.broadcast_to(arm.ranges, (len(arm.joints), 3)).T
    return np.where((lower <= 0) & (upper >= 0), 0.0, middle)


def _links(urdf: Path, geometry: Sequence[Geometry]) -> list[LinkShape]:
    surfaces: dict[str, list[Array]] = {}
    read = count = 0
    for part in geometry:
        with naming(f"link {part.link}"):
            if part.shape == "mesh":
                file = mesh_file(urdf, part.file)
                read += file.stat().st_size
                require_at_most(read, "mesh_bytes", "bytes of meshes")
                corners = read_mesh(file) * part.sizes
                if np.prod(part.sizes) < 0:
                    corners = corners[:, ::-1]
            else:
                corners = _primitive(part)
            count += len(corners)
            require_at_most(count, "faces", "triangles of meshes")
        turned = corners @ Rotation.from_euler("xyz", part.rpy).as_matrix().T
        surfaces.setdefault(part.link, []).append(turned + part.xyz)
    links = [_link(name, np.concatenate(parts)) for name, parts in surfaces.items()]
    return [link for link in links if len(link.faces)]


def _link(name: str, corners: Array) -> LinkShape:
    size = np.ptp(corners, axis=(0, 1)).max()
    if size > _LARGEST_M:
        raise ValueError(
            f"link {name}: is {size:.4g} m large; lengths are metres; give a mesh in millimetres"
            ' scale="0.001 0.001 0.001"'
        )
    cell = _SAME_M
    if len(corners) > _MANY:
        cell = _CELL_M
    return LinkShape(name, *merged(corners, cell))


def _primitive(part: Geometry) -> Array:
    """(m, 3, 3) corners of its triangles."""
    creation = optional_module("trimesh.creation", "geometry needs trimesh", "urdf")
    if part.shape == "box":
        mesh = creation.box(part.sizes)
    elif part.shape == "cylinder":
        mesh = creation.cylinder(*part.sizes, sections=64)
    elif part.shape == "sphere":
        mesh = creation.icosphere(4, *part.sizes)
    else:
        raise ValueError(f"its {part.kind} is no mesh, box, cylinder or sphere")
    return np.array(mesh.vertices[mesh.faces])
