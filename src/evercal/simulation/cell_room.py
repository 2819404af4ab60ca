"""The room of the virtual cell: a box room with a work table, boxes on it, and the arm.

Base frame: origin at the foot of the arm, on the table's top, z up, x over the table.
"""

from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.random import default_rng

from evercal.geometry import SE3
from evercal.simulation.box_room import BoxRoom
from evercal.simulation.panda_arm import joint_frames
from evercal.simulation.surfaces import Pyramid, Surface, box_faces, unit_vector
from evercal.typing import Array

TABLE_M = 0.75
"""Height of the table over the floor."""
WORK_AREA_M = np.array([0.52, 0.0, 0.04])
"""Centre of the work area that cameras look at, base frame."""

THING_LOW_M = np.array([-0.08, -0.06, 0.1])
"""Lowest corner of the box that the gripper holds, flange frame: the fingers are 10 cm long."""
THING_SIZE_M = np.array([0.16, 0.12, 0.24])
"""Sides of the box that the gripper holds, along the axes of the flange, metres."""

_TABLE_LOW_M = np.array([-0.35, -0.65, -0.04])
"""Lowest corner of the table's top, base frame."""
_TABLE_SIZE_M = np.array([1.4, 1.3, 0.04])
"""Sides of the table's top, metres."""
_FREE_M = 0.28
"""Distance from the foot of the arm within which no box stands, metres."""
_LINK_M = 0.1
"""Width of the boxes that stand for the arm's links, metres."""
_TEXTURE_PX = 512
"""Side of the textures of the room, pixels."""
_TABLE_TEXTURE_PX = 1024
"""Side of the textures of the table, pixels."""
_BOX_TEXTURE_PX = 128
"""Side of the textures of the boxes on the table, pixels."""


@lru_cache(maxsize=4)
def cell_room(seed: int) -> BoxRoom:
    """The room without the arm, in the base frame."""
    rng = default_rng([seed, 31])
    room = BoxRoom(seed, furniture=6, texture_px=_TEXTURE_PX)
    down = np.array([0.0, 0.0, TABLE_M])
    for i, surface in enumerate(room.surfaces):
        room.surfaces[i] = replace(surface, corner_m=surface.corner_m - down)
    room.texture_px = _TABLE_TEXTURE_PX
    room.add_box(_TABLE_LOW_M, _TABLE_SIZE_M, rng)
    room.texture_px = _BOX_TEXTURE_PX
    for _ in range(12):
        size = rng.uniform((0.04, 0.04, 0.02), (0.14, 0.14, 0.16))
        aside = rng.uniform(-1, 1, 2) * (0.32, 0.42)
        centre = WORK_AREA_M[:2] + aside
        away = np.linalg.norm(centre)
        centre *= max(1.0, _FREE_M / away)
        low = np.append(centre - size[:2] / 2, 0.0)
        room.add_box(low, size, rng)
    return room


def arm_surfaces(joints_rad: Array) -> list[Surface]:
    """Boxes along the links of the arm for joint angles (7,)."""
    frames = joint_frames(joints_rad)
    origins = frames[[0, 2, 3, 4, 6, 7], :3, 3]
    points = np.concatenate([np.zeros((1, 3)), origins])
    surfaces = []
    for start, end in pairwise(points):
        along = end - start
        length = np.linalg.norm(along)
        if length < 1e-6:
            continue
        up = along / length
        axis = np.array([0.0, 1.0, 0.0])
        if abs(up[1]) >= 0.9:
            axis = np.array([1.0, 0.0, 0.0])
        side = unit_vector(np.cross(up, axis))
        width = _LINK_M * side
        depth = _LINK_M * np.cross(up, side)
        low = start - (width + depth) / 2
        for face in box_faces(low, np.stack([width, depth, along])):
            surfaces.append(Surface(*face, _link_texture()))
    return surfaces


def thing_surfaces(seed: int, base_from_gripper: SE3) -> list[Surface]:
    """The textured box that the gripper holds."""
    rotation = base_from_gripper.rotation_matrix()
    surfaces = []
    for thing in _thing(seed):
        surfaces.append(
            Surface(
                corner_m=base_from_gripper.apply(thing.corner_m),
                edge_u_m=rotation @ thing.edge_u_m,
                edge_v_m=rotation @ thing.edge_v_m,
                pyramid=thing.pyramid,
            )
        )
    return surfaces


@lru_cache(maxsize=4)
def _thing(seed: int) -> list[Surface]:
    """The held box in the flange frame."""
    rng = default_rng([seed, 36])
    room = cell_room(seed)
    edges = np.diag(THING_SIZE_M)
    corner = THING_LOW_M + edges[1]
    bottom = (corner, edges[0], -edges[1])
    faces = box_faces(THING_LOW_M, edges)
    faces.append(bottom)
    return [Surface(*face, room.texture(rng, calm=False)) for face in faces]


@lru_cache(maxsize=1)
def _link_texture() -> Pyramid:
    picture = np.full((16, 16, 3), 205, np.uint8)
    picture[[0, -1]] = 150
    picture[:, [0, -1]] = 150
    return (picture,)
