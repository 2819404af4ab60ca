"""Arms of several kinds, joint values, and the motions of a camera between images of them."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from evercal.geometry import SE3, norms
from evercal.geometry.motions import PairMotions
from evercal.robot.arm import Arm, MovingJoint
from evercal.robot.mount import EYE_IN_HAND, Mount
from evercal.simulation.panda_arm import HIGH_RAD, LINKS, LOW_RAD
from evercal.typing import Array

X, Y, Z = np.eye(3)
SLIDES = "slides"


def arm(*joints: tuple[Any, ...], names: Sequence[str] = ()) -> Arm:
    """An arm of joints with an origin, an axis, and whether they slide."""
    chain = []
    for i, (origin, axis, *slides) in enumerate(joints):
        before = np.eye(4)
        before[:3, 3] = origin
        chain.append(MovingJoint(before, np.array(axis, float), not slides, i))
    last = np.eye(4)
    last[2, 3] = 0.1
    count = len(joints)
    ranges = np.tile([-2.6, 0.0, 2.6], (count, 1))
    names = names or [f"joint_{i + 1}" for i in range(count)]
    return Arm(tuple(names), tuple(chain), last, ranges)


def panda() -> Arm:
    """Seven axes, by Franka's parameters."""
    chain = []
    for i, (along, up, twist) in enumerate(LINKS[:7]):
        before = np.eye(4)
        before[:3, :3] = Rotation.from_euler("x", twist).as_matrix()
        before[:3, 3] = before[:3, :3] @ [0, 0, up] + [along, 0, 0]
        chain.append(MovingJoint(before, Z, True, i))
    last = np.eye(4)
    last[2, 3] = 0.107
    ranges = np.stack([LOW_RAD, (LOW_RAD + HIGH_RAD) / 2, HIGH_RAD], 1)
    return Arm(tuple(f"panda_joint{i + 1}" for i in range(7)), (*chain,), last, ranges)


ARMS = {
    "welder": arm(
        ((0, 0, 0.3), Z),
        ((0.1, 0, 0.1), Y),
        ((0, 0, 0.5), -Y),
        ((0.1, 0, 0.1), -X),
        ((0.5, 0, 0), -Y),
        ((0.1, 0, 0), -X),
    ),
    "cobot": arm(
        ((0, 0, 0.16), Z),
        ((0, 0.13, 0), Y),
        ((0, -0.12, 0.42), Y),
        ((0, 0, 0.39), Y),
        ((0, 0.1, 0), Z),
        ((0, 0, 0.1), Y),
    ),
    "hobby": arm(
        ((0, 0, 0.06), Z),
        ((0.03, 0, 0.05), Y),
        ((0.03, 0, 0.11), Y),
        ((0.13, 0, 0), Y),
        ((0.06, 0, 0), X),
        names=[
            "shoulder_pan",
            "shoulder_lift",
            "elbow_flex",
            "wrist_flex",
            "wrist_roll",
        ],
    ),
    "panda": panda(),
    "scara": arm(
        ((0, 0, 0.3), Z),
        ((0.3, 0, 0), Z),
        ((0.25, 0, 0), -Z, SLIDES),
        ((0, 0, 0), -Z),
    ),
    "gantry": arm(
        ((0, 0, 0), X, SLIDES),
        ((0, 0, 0), Y, SLIDES),
        ((0, 0, 1), -Z, SLIDES),
        ((0, 0, -0.1), Z),
        ((0, 0, 0), Y),
        ((0, 0, -0.1), X),
    ),
}


def joint_values(arm: Arm, rng: np.random.Generator, count: int = 20) -> Array:
    """Values around a posture."""
    middle = arm.ranges[:, 1] + rng.uniform(-0.5, 0.5, len(arm.joints))
    size = np.where(arm.rotates(), 0.45, 0.12)
    return middle + rng.normal(0, size, (count, len(size)))


def motions(
    arm: Arm, values: Array, rng: np.random.Generator, mount: Mount = EYE_IN_HAND
) -> PairMotions:
    """Those of similar images, with 0.7 deg of noise; one in ten is wrong."""
    carried = SE3.exp(np.r_[rng.normal(0, 0.05, 3), rng.normal(0, 1.5, 3)])
    cameras = mount.scene_from_parent(arm.poses(values)) @ carried
    pairs = np.stack(np.triu_indices(len(values), 1), 1)
    between = cameras[pairs[:, 0]].inverse() @ cameras[pairs[:, 1]]
    chosen = rng.permutation(np.argsort(norms(between.rotation.as_rotvec()))[:90])[:36]
    noise = np.pad(rng.normal(0, np.deg2rad(0.7), (36, 3)), ((0, 0), (3, 0)))
    turns = (between[chosen] @ SE3.exp(noise)).rotation.as_rotvec()
    directions = between[chosen].translation_m
    directions /= norms(directions)[:, None] + 1e-9
    directions += rng.normal(0, 0.05, directions.shape)
    wrong = rng.random(36) < 0.1
    turns[wrong] = rng.normal(0, 0.5, (wrong.sum(), 3))
    directions[wrong] = rng.normal(0, 1, (wrong.sum(), 3))
    directions /= norms(directions)[:, None]
    return PairMotions(pairs[chosen], turns, directions)
