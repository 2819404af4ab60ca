"""Tracks that are made by projection, for bundle adjustment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evercal.geometry import SE3, Camera, pose_distance
from evercal.mapping.bundle_adjustment import BundleAdjustment
from evercal.mapping.bundle_equations import Adjustment, BundleTracks
from evercal.mapping.bundle_options import BundleOptions
from evercal.mapping.stated_errors import StatedErrors
from evercal.simulation.box_room import look_at
from evercal.typing import Array

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
FRAMES = 30


def path(times: Array) -> SE3:
    """A smooth walk in front of a wall, rotating about all axes."""
    poses = []
    for t in times / FRAMES * 2 * np.pi:
        eye = np.array(
            [0.6 * np.sin(t), 0.4 * np.cos(2 * t + 1), 1.4 + 0.3 * np.sin(3 * t)]
        )
        ahead = np.array([0.3 * np.cos(2 * t), 2.5, 0.3 * np.sin(t)])
        poses.append(look_at(eye, eye + ahead, 0.5 * np.sin(t + 2)))
    return SE3.stack(poses)


@dataclass
class World:
    """Tracks, and the poses, camera and depths that they were made with."""

    truth: SE3
    tracks: BundleTracks
    camera: Camera
    inverse_depth: Array


def world(
    camera: Camera = CAMERA,
    noise_px: float = 0.2,
    seed: int = 0,
    truth: SE3 | None = None,
    every: int = 3,
    landmarks: int = 25,
) -> World:
    """Landmarks of every third frame at random depths, observed by all frames that see them."""
    rng = np.random.default_rng(seed)
    poses = truth or path(np.arange(float(FRAMES)))
    host = np.repeat(np.arange(0, len(poses), every), landmarks)
    pixels = rng.uniform([40, 40], [600, 440], (len(host), 2))
    inverse = 1 / rng.uniform(1.5, 4.0, len(host))
    rays = camera.unproject(pixels)
    landmark = []
    frame = []
    observed = []
    points = np.stack(
        [
            poses[int(k)].apply(r / d)
            for k, r, d in zip(host, rays, inverse, strict=True)
        ]
    )
    for j in range(len(poses)):
        local = poses[j].inverse().apply(points)
        ahead = local[:, 2] > 0.3
        pixel = camera.project(np.where(ahead[:, None], local, [0, 0, 1]))
        inside = ahead & (host != j) & (pixel > 5).all(1) & (pixel < [634, 474]).all(1)
        which = np.flatnonzero(inside)
        landmark.append(which)
        frame.append(np.full(len(which), j))
        observed.append(pixel[which] + rng.normal(0, noise_px, (len(which), 2)))
    landmarks_ = np.concatenate(landmark)
    tracks = BundleTracks(
        host=host,
        pixels=pixels,
        inverse_depth=inverse * (1 + rng.normal(0, 0.01, len(inverse))),
        landmark=landmarks_,
        frame=np.concatenate(frame),
        observed=np.concatenate(observed),
        whitening=np.tile(np.eye(2) / 0.3, (len(landmarks_), 1, 1)),
    )
    return World(poses, tracks, camera, inverse)


def problem(
    stated: SE3,
    camera: Camera = CAMERA,
    velocity: Array | None = None,
    options: BundleOptions | None = None,
) -> BundleAdjustment:
    if velocity is None:
        velocity = np.zeros((len(stated), 6))
    cameras = [camera] * len(stated)
    errors = StatedErrors(velocity)
    return BundleAdjustment(stated, cameras, errors, options or BundleOptions())


def adjusted(
    made: World,
    stated: SE3,
    camera: Camera | None = None,
    velocity: Array | None = None,
    options: BundleOptions | None = None,
) -> Adjustment:
    return problem(stated, camera or made.camera, velocity, options).solve(made.tracks)


def jittered(poses: SE3, sigma_m: float, sigma_rad: float, seed: int = 1) -> SE3:
    noise = np.random.default_rng(seed).normal(size=(len(poses), 6))
    return poses @ SE3.exp(noise * ([sigma_m] * 3 + [sigma_rad] * 3))


def errors(poses: SE3, truth: SE3) -> tuple[Array, Array]:
    """Metres and radians of each pose."""
    both = [pose_distance(poses[i], truth[i]) for i in range(len(truth))]
    return np.array([m for m, _ in both]), np.array([r for _, r in both])


def without_gauge(poses: SE3, truth: SE3) -> SE3:
    """Poses after the common motion that fits them to the true ones."""
    mean = (truth @ poses.inverse()).log().mean(0)
    return SE3.exp(mean) @ poses


def velocities(stated: SE3) -> Array:
    """(n, 6) motion per frame by central differences."""
    steps = (stated[:-1].inverse() @ stated[1:]).log()
    velocity = np.zeros((len(stated), 6))
    velocity[1:-1] = (steps[:-1] + steps[1:]) / 2
    return velocity
