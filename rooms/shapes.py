"""Triangle meshes: bevelled boxes, bodies of revolution, tubes, cushions, sheets.

Positions and texture coordinates are in metres, so the `tile_m` of a material sets the size of its
pattern. Only the texture coordinates of `sheet` run from 0 to 1, for pictures.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with smooth normals."""

    vertices_m: np.ndarray
    """Positions, shape (n, 3)."""
    faces: np.ndarray
    """Vertex indices, counter-clockwise from outside, shape (m, 3)."""
    normals: np.ndarray
    """Outward unit normals, shape (n, 3)."""
    uv: np.ndarray
    """Texture coordinates, metres along the surface, shape (n, 2)."""
    name: str = ""
    """Name of a mesh that can be moved; empty for static meshes."""

    @classmethod
    def merged(cls, meshes: Sequence["Mesh"]) -> "Mesh":
        """Merge meshes into one with the name of the first."""
        faces = []
        start = 0
        for mesh in meshes:
            faces.append(mesh.faces + start)
            start += len(mesh.vertices_m)
        return cls(
            np.concatenate([mesh.vertices_m for mesh in meshes]),
            np.concatenate(faces),
            np.concatenate([mesh.normals for mesh in meshes]),
            np.concatenate([mesh.uv for mesh in meshes]),
            meshes[0].name,
        )

    def placed(self, position_m: ArrayLike, yaw_rad: float = 0.0) -> "Mesh":
        """The mesh rotated about z, then shifted."""
        c = np.cos(yaw_rad)
        s = np.sin(yaw_rad)
        rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return self.rotated(rotation, position_m)

    def rotated(
        self, rotation: np.ndarray, position_m: ArrayLike = (0, 0, 0)
    ) -> "Mesh":
        """The mesh rotated by a (3, 3) matrix, then shifted."""
        return replace(
            self,
            vertices_m=self.vertices_m @ rotation.T + np.asarray(position_m, float),
            normals=self.normals @ rotation.T,
        )

    def transformed(self, matrix: np.ndarray) -> "Mesh":
        """The mesh moved by a rigid transform (4, 4)."""
        return self.rotated(matrix[:3, :3], matrix[:3, 3])

    def shifted(self, x: float, y: float, z: float) -> "Mesh":
        """The mesh shifted by (x, y, z) metres."""
        return replace(self, vertices_m=np.add(self.vertices_m, (x, y, z)))

    def scaled(self, factor: float) -> "Mesh":
        """The mesh scaled about the origin; its pattern keeps its size in metres."""
        return replace(self, vertices_m=self.vertices_m * factor, uv=self.uv * factor)


def about_x(angle_rad: float) -> np.ndarray:
    """Rotation matrix about x."""
    c = np.cos(angle_rad)
    s = np.sin(angle_rad)
    return np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])


FORWARD = about_x(np.pi / 2)
"""Rotation that turns z, the axis of a body of revolution, to -y, the front of furniture."""


def about_y(angle_rad: float) -> np.ndarray:
    """Rotation matrix about y."""
    c = np.cos(angle_rad)
    s = np.sin(angle_rad)
    return np.array([[c, 0, s], [0, 1.0, 0], [-s, 0, c]])


def mirrored(x: float) -> tuple[float, float]:
    """Two places that are symmetric to x = 0."""
    return -x, x


def positions(*coordinates: ArrayLike) -> np.ndarray:
    """Points (..., n) from n coordinates, each an array or one number for all points."""
    return np.stack(np.broadcast_arrays(*coordinates), -1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., n) scaled to length 1; zeros stay zeros."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.maximum(length, 1e-12)


def _arc_length(path: np.ndarray) -> np.ndarray:
    """Distance from the first of the points (n, d) along their path, shape (n, 1)."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=-1)
    return np.concatenate([[0], np.cumsum(steps)])[:, None]


def _grid(points: np.ndarray, normals: np.ndarray, uv: np.ndarray) -> Mesh:
    """A surface through points (rows, columns, 3); normals define the outside."""
    rows, columns = points.shape[:2]
    number = np.arange(rows * columns).reshape(rows, columns)
    a = number[:-1, :-1]
    c = number[1:, 1:]
    halves = [positions(a, number[:-1, 1:], c), positions(a, c, number[1:, :-1])]
    faces = np.concatenate(halves).reshape(-1, 3)
    vertices = points.reshape(-1, 3)
    flat = normals.reshape(-1, 3)
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=-1)
    if (cross * flat[faces[:, 0]]).sum() < 0:
        faces = faces[:, ::-1]
    return Mesh(vertices, faces[area > 1e-14], flat, uv.reshape(-1, 2))


def box(
    x: float,
    y: float,
    z: float,
    bevel_m: float = 0.006,
    bottom: bool = True,
    steps: int = 2,
) -> Mesh:
    """A bevelled box on z = 0, centred at x = y = 0.

    Its sides are x, y and z metres, and its edges are rounded in `steps` segments.
    """
    half = np.array([x, y, z]) / 2
    radius = min(bevel_m, 0.499 * min(x, y, z))
    inner = half - radius
    ring = np.tan(np.linspace(0, np.pi / 4, steps + 1)) * radius
    # A flat face between its bevels is two triangles.
    lines = [np.concatenate([-side - ring[::-1], side + ring]) for side in inner]
    meshes = []
    # Upright faces carry their texture upright, with v along z. Seen from outside, u runs to the
    # right; otherwise writing would be mirrored.
    for axis, u_axis, v_axis, right in ((0, 1, 2, 1), (1, 0, 2, -1), (2, 0, 1, 1)):
        a = (axis + 1) % 3
        b = (axis + 2) % 3
        flat = np.empty((len(ring) * 2, len(ring) * 2, 3))
        flat[..., a], flat[..., b] = np.meshgrid(lines[a], lines[b], indexing="ij")
        for sign in (1.0, -1.0):
            if axis == 2 and sign < 0 and not bottom:
                continue
            flat[..., axis] = sign * half[axis]
            core = np.clip(flat, -inner, inner)
            normal = _unit(flat - core)
            points = core + radius * normal
            uv = positions(right * sign * points[..., u_axis], points[..., v_axis])
            meshes.append(_grid(points, normal, uv))
    return Mesh.merged(meshes).shifted(0, 0, z / 2)


def lathe(profile: ArrayLike, segments: int = 28, smooth: int = 3) -> Mesh:
    """A body of revolution about z.

    The profile holds (radius, height) pairs in metres, from the bottom of the outside over the rim
    to the bottom of the inside. The outside is to the right of this direction. Each step is
    `smooth` spline pieces; 1 keeps straight steps.
    """
    points = np.asarray(profile, float)
    if smooth > 1:
        points = _spline(points, smooth)
        points[:, 0] = np.maximum(points[:, 0], 0.0)
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    tangent = np.gradient(points, axis=0)
    normal = _unit(positions(tangent[:, 1], -tangent[:, 0]))
    uv = positions(angle * points[:, 0].max(), _arc_length(points))
    return _grid(_revolved(points, angle), _revolved(normal, angle), uv)


def _revolved(profile: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Pairs (n, 2) along the radius and along z, turned about z by angles (m,): (n, m, 3)."""
    radius = profile[:, :1]
    return positions(radius * np.cos(angle), radius * np.sin(angle), profile[:, 1:])


def lampshade(*outside: tuple[float, float]) -> list[tuple[float, float]]:
    """Profile of a thin wall, open below and above, from the profile of its outside."""
    inside = [(radius - 0.002, height) for radius, height in reversed(outside)]
    return [*outside, *inside]


def _spline(points: np.ndarray, pieces: int) -> np.ndarray:
    """A Catmull-Rom spline through points (k, 2)."""
    padded = np.concatenate([points[:1], points, points[-1:]])
    t = np.arange(pieces)[:, None] / pieces
    parts = []
    for i in range(len(points) - 1):
        a, b, c, d = padded[i : i + 4]
        square = 2 * a - 5 * b + 4 * c - d
        cube = 3 * b - a - 3 * c + d
        parts.append(0.5 * (2 * b + (c - a) * t + square * t**2 + cube * t**3))
    return np.concatenate([*parts, points[-1:]])


def cylinder(
    radius: float, height: float, bevel_m: float = 0.004, segments: int = 28
) -> Mesh:
    """A cylinder with bevelled ends on z = 0."""
    r = radius
    b = min(bevel_m, 0.45 * height, 0.45 * radius)
    k = b * (1 - np.sqrt(0.5))
    # Doubled points keep the ends flat although normals are smoothed.
    profile = [
        (0, 0), (r - b - 1e-4, 0), (r - b, 0), (r - k, k), (r, b), (r, b + 1e-4),
        (r, height - b - 1e-4), (r, height - b), (r - k, height - k), (r - b, height),
        (r - b - 1e-4, height), (0, height),
    ]  # fmt: skip
    return lathe(profile, segments, smooth=1)


def ball(radius: float, squash: float = 1.0, segments: int = 24) -> Mesh:
    """A sphere on z = 0, scaled along z by `squash`."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, segments // 2 + 1)
    z = squash * radius * (1 + np.sin(angle))
    return lathe(list(zip(radius * np.cos(angle), z, strict=True)), segments, smooth=1)


def tube(path: ArrayLike, radius: float, segments: int = 10) -> Mesh:
    """A round bar along a path (k, 3) in metres."""
    path = np.asarray(path, float)
    tangent = _unit(np.gradient(path, axis=0))
    reference = np.array([0.0, 0.0, 1.0])
    if np.abs(tangent @ reference).max() > 0.95:
        reference = np.array([1.0, 0.3, 0.0]) / np.hypot(1, 0.3)
    side = _unit(np.cross(tangent, reference))[:, None]
    up = np.cross(side, tangent[:, None])
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    uv = positions(angle * radius, _arc_length(path))
    angle = angle[:, None]
    normal = side * np.cos(angle) + up * np.sin(angle)
    return _grid(path[:, None] + radius * normal, normal, uv)


def cushion(x: float, y: float, z: float, cells: int = 12) -> Mesh:
    """A pillow on z = 0, thick in the middle and thin at the seam."""
    s = np.sin(np.linspace(-np.pi / 2, np.pi / 2, cells + 1))
    u, v = np.meshgrid(s, s, indexing="ij")
    bulge = np.sqrt(np.clip((1 - u**4) * (1 - v**4), 0, 1))
    # Seams pull inwards between the corners.
    pull = 1 - 0.06 * (1 - bulge) * np.cos(u * v * np.pi / 2)
    uv = positions(u * x / 2, v * y / 2)
    halves = []
    for sign in (1.0, -1.0):
        height = z / 2 * (1 + sign * bulge)
        p = positions(u * pull * x / 2, v * pull * y / 2, height)
        halves.append(_grid(p, sign * _normals(p), uv))
    return Mesh.merged(halves)


def _normals(points: np.ndarray) -> np.ndarray:
    """Upward unit normals of a height field (rows, columns, 3)."""
    normal = np.cross(*np.gradient(points, axis=(0, 1)))
    degenerate = np.linalg.norm(normal, axis=-1) <= 1e-12
    normal = _unit(normal)
    normal[degenerate] = (0.0, 0.0, 1.0)
    return normal * np.where(normal[..., 2:].sum() < 0, -1.0, 1.0)


def sheet(corner_m: ArrayLike, u_m: ArrayLike, v_m: ArrayLike) -> Mesh:
    """A flat rectangle with normal u x v and texture coordinates from 0 to 1."""
    corner, u, v = np.array([corner_m, u_m, v_m], float)
    normal = np.tile(_unit(np.cross(u, v)), (4, 1))
    corners = np.stack([corner, corner + u, corner + u + v, corner + v])
    uv = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), normal, uv)


def _both_sides(points: np.ndarray, normals: np.ndarray, uv: np.ndarray) -> Mesh:
    """A thin surface as two, 1 mm apart, because back sides are not rendered."""
    step = 5e-4 * normals
    front = _grid(points + step, normals, uv)
    return Mesh.merged([front, _grid(points - step, -normals, uv)])


def drape(
    width: float, height: float, fold_m: float, folds: int, seed: int | None = 0
) -> Mesh:
    """A curtain around the plane y = 0 with folds along y, from z = height to 0.

    The folds differ in width; without a seed they are equal.
    """
    x = np.linspace(-width / 2, width / 2, folds * 8 + 1)
    z = np.linspace(0, height, 9)
    phase = 2 * np.pi * folds * (x / width)
    if seed is not None:
        phase += 0.6 * np.sin(3 * x + np.random.default_rng(seed).uniform(0, 6))
    grid_x, grid_z = np.meshgrid(x, z, indexing="ij")
    swing = fold_m * np.sin(phase)[:, None] * (1 - 0.35 * (grid_z / height))
    p = positions(grid_x, -swing, grid_z)
    normal = _unit(np.cross(*np.gradient(p, axis=(0, 1))))
    return _both_sides(p, normal, positions(grid_x * 1.4, grid_z))


def leaf(length: float, width: float, droop: float, cells: int = 6) -> Mesh:
    """A leaf from the origin along +x that bends down by `droop` radians."""
    t = np.linspace(0, 1, cells + 1)
    angle = 0.9 - droop * t
    step = positions(np.cos(angle), 0.0, np.sin(angle)) * length / cells
    spine = np.concatenate([np.zeros((1, 3)), np.cumsum(step, axis=0)[:-1]])
    half = width / 2 * np.sin(np.pi * np.clip(t * 0.94 + 0.06, 0, 1)) ** 0.8
    across = np.array([-1.0, 0.0, 1.0])
    p = np.repeat(spine[:, None], 3, axis=1)
    p[..., 1] += half[:, None] * across
    p[..., 2] += 0.25 * half[:, None] * np.abs(across)
    uv = positions(across * width / 2, t[:, None] * length)
    return _both_sides(p, _normals(p), uv)
