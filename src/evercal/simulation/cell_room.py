"""The room of the virtual cell: a box room with a work table, boxes on it, and the arm.

Base frame: origin at the foot of the arm, on the table's top, z up, x over the table.
"""

from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import numpy as np

from evercal.geometry import SE3
from evercal.simulation.box_room import BoxRoom, Surface, box_faces
from evercal.simulation.panda_arm import joint_frames

TABLE_M = 0.75
"""Height of the table over the floor."""
WORK_AREA_M = np.array([0.52, 0.0, 0.04])
"""Centre of the work area that cameras look at, base frame."""

THING_LOW_M, THING_SIZE_M = np.array([-0.08, -0.06, 0.1]), np.array([0.16, 0.12, 0.24])
"""Lowest corner and sides of what the gripper holds, flange frame: the fingers are 10 cm long."""

_TABLE_LOW = np.array([-0.35, -0.65])
_TABLE_HIGH = np.array([1.05, 0.65])
_FREE_M = 0.28
"""Distance from the foot of the arm within which no box stands."""
_LINK_M = 0.1
_TEXTURE_PX = 512
_TABLE_TEXTURE_PX = 1024
_BOX_TEXTURE_PX = 128


@lru_cache(maxsize=4)
def cell_room(seed: int, boxes: int = 12) -> BoxRoom:
    """The room without the arm, in the base frame."""
    rng = np.random.default_rng([seed, 31])
    room = BoxRoom(seed, furniture=6, texture_px=_TEXTURE_PX)
    down = np.array([0.0, 0.0, TABLE_M])
    room.surfaces = [
        replace(surface, corner_m=surface.corner_m - down) for surface in room.surfaces
    ]
    room.texture_px = _TABLE_TEXTURE_PX
    size = np.array([*(_TABLE_HIGH - _TABLE_LOW), 0.04])
    room.add_box(np.array([*_TABLE_LOW, -0.04]), size, rng)
    room.texture_px = _BOX_TEXTURE_PX
    for _ in range(boxes):
        size = np.array([*rng.uniform(0.04, 0.14, 2), rng.uniform(0.02, 0.16)])
        centre = WORK_AREA_M[:2] + rng.uniform(-1, 1, 2) * (0.32, 0.42)
        away = np.linalg.norm(centre)
        centre *= max(1.0, _FREE_M / away)
        room.add_box(np.array([*(centre - size[:2] / 2), 0.0]), size, rng)
    return room


def arm_surfaces(joints_rad: np.ndarray) -> list[Surface]:
    """Boxes along the links of the arm for joint angles (7,)."""
    frames = joint_frames(joints_rad)
    points = np.concatenate([np.zeros((1, 3)), frames[[0, 2, 3, 4, 6, 7], :3, 3]])
    surfaces = []
    for start, end in pairwise(points):
        along = end - start
        length = np.linalg.norm(along)
        if length < 1e-6:
            continue
        up = along / length
        side = np.cross(up, [0.0, 1.0, 0.0] if abs(up[1]) < 0.9 else [1.0, 0.0, 0.0])
        side /= np.linalg.norm(side)
        edges = np.stack([_LINK_M * side, _LINK_M * np.cross(up, side), along])
        low = start - (edges[0] + edges[1]) / 2
        surfaces += [Surface(*face, _link_texture()) for face in box_faces(low, edges)]
    return surfaces


def thing_surfaces(seed: int, base_from_gripper: SE3) -> list[Surface]:
    """The textured box that the gripper holds."""
    rotation = base_from_gripper.rotation_matrix()
    return [
        Surface(base_from_gripper.apply(corner), rotation @ u, rotation @ v, pyramid)
        for corner, u, v, pyramid in _thing(seed)
    ]


@lru_cache(maxsize=4)
def _thing(
    seed: int,
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, tuple[np.ndarray, ...]]]:
    rng = np.random.default_rng([seed, 36])
    edges = np.diag(THING_SIZE_M)
    bottom = THING_LOW_M + edges[1], edges[0], -edges[1]
    faces = [*box_faces(THING_LOW_M, edges), bottom]
    return [(*face, cell_room(seed).texture(rng, calm=False)) for face in faces]


@lru_cache(maxsize=1)
def _link_texture() -> tuple[np.ndarray, ...]:
    picture = np.full((16, 16, 3), 205, np.uint8)
    picture[[0, -1]] = picture[:, [0, -1]] = 150
    return (picture,)
