"""Rendered rooms for `guard`: hand-held views that are far from all training views.

A phone-like lens that is stated as a pinhole, motion blur, an exposure that changes, noise, JPEG.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.lenses import View
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, pose_distance
from evercal.recordings.frame import Frame, Recording
from evercal.recordings.images import write_jpeg
from evercal.simulation.panda_arm import HOME_RAD
from rooms.panda import panda_meshes
from rooms.paths import free_path
from rooms.renderer import Renderer, RenderOptions
from rooms.room import room

ROOMS = {"kitchen": 7101, "living": 7102}
"""Seeds of the rooms, by kind."""
TRAIN = 40
"""Training images of a room."""
TEST = 30
"""Test images of a room."""
PATH = 400
"""Views of a path around the room; training takes the first `LEARNED` of them."""
LEARNED = 140
NEAREST = (0.3, 20.0)
"""Metres and degrees that every training view is away from a test view, at least."""
FARTHEST = (1.5, 60.0)
"""Metres and degrees that some training view is away from a test view, at most."""
LENS = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, (0.02, -0.015, 0.0, 0.0))
"""The lens; its distortion, 2.7 px at the corners, is not stated."""
DRAWN = Camera(672, 504, 500.0, 500.0, 335.5, 251.5)
"""Pinhole that is rendered, wider than the lens."""
TREMOR = (0.001, 0.1)
"""Standard deviations of the motion during an exposure, metres and degrees per axis."""
QUALITY = 90
"""JPEG quality."""
RENDER = RenderOptions(samples=8, noise=0.03, blur_steps=2)
EXPOSURE_EV = {"train": (0.0, 0.2), "test": (-0.6, 0.3)}
"""Mean and standard deviation of the exposure of images, stops."""


def far_views(kind: str) -> tuple[SE3, SE3]:
    """Training views on a part of a path, test views on the rest that are far from them.

    Raises:
        InputError: Too few views are far.
    """
    path = free_path(room(kind, ROOMS[kind]), PATH, [0, 1])
    train = path[np.linspace(0, LEARNED, TRAIN).astype(int)]
    metres, radians = pose_distance(path[:, None], train[None])
    degrees = np.rad2deg(radians)
    far = (metres >= NEAREST[0]) & (degrees >= NEAREST[1])
    related = (metres <= FARTHEST[0]) & (degrees <= FARTHEST[1])
    found = np.flatnonzero(far.all(1) & related.any(1))
    if len(found) < TEST:
        raise InputError(f"{kind}: {len(found)} of {TEST} views are far")
    return train, path[found[np.linspace(0, len(found) - 1, TEST).astype(int)]]


def far_room(kind: str, folder: Path) -> Recording:
    """Render a room; images that the folder has are kept.

    Raises:
        InputError: Mitsuba or the meshes of the arm are missing, or too few views are far.
    """
    train, test = far_views(kind)
    learned = tuple(_frames(kind, "train", train, folder))
    return Recording(f"far-{kind}", learned, tuple(_frames(kind, "test", test, folder)))


def _frames(kind: str, part: str, poses: SE3, folder: Path) -> Iterator[Frame]:
    renderer: Renderer | None = None
    stated = replace(LENS, distortion=())
    mean, spread = EXPOSURE_EV[part]
    for i, pose in enumerate(poses):
        file = folder / kind / f"{part}-{i:03d}.jpg"
        if not file.exists():
            if renderer is None:
                arm = panda_meshes(HOME_RAD)
                renderer = Renderer(room(kind, ROOMS[kind]).meshes() + arm)
            rng = np.random.default_rng([ROOMS[kind], i, part == "test"])
            exposure = mean + spread * float(rng.normal())
            options = replace(RENDER, exposure_ev=exposure)
            moving = _exposure(pose, rng)
            drawn = renderer.render(DRAWN, moving, options, int(rng.integers(2**31)))
            write_jpeg(file, View(LENS).render(drawn, DRAWN), QUALITY)
        yield Frame(f"{part}-{i:03d}", file, stated, pose)


def _exposure(pose: SE3, rng: np.random.Generator) -> SE3:
    """Poses during an exposure whose middle is the pose."""
    metres, degrees = TREMOR
    change = rng.normal(size=6) * np.repeat([metres, np.deg2rad(degrees)], 3)
    shares = np.linspace(-0.5, 0.5, RENDER.blur_steps)
    return SE3.stack([pose @ SE3.exp(share * change) for share in shares])
