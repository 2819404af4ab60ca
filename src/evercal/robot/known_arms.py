"""`known_arm`: the kinematics of an arm by its name, from its maker's numbers."""

import json
import re
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from evercal.choices import ArmClass
from evercal.errors import InputError
from evercal.robot.arm import Arm, MovingJoint

_FILE = Path(__file__).with_name("arms.json")
"""Millimetres and degrees by the name of an arm.

`links` are Craig's Denavit-Hartenberg parameters a, alpha, d, theta up to each joint and up to the
flange, `rest` is a usual posture.
"""
_TOOLS_M = (0.0, 0.1, 0.2, 0.3)
"""Lengths of an unknown tool."""


@cache
def _arms() -> dict[str, Any]:
    return json.loads(_FILE.read_text(encoding="utf-8"))


ARM_NAMES: dict[str, ArmClass] = {name: arm["kind"] for name, arm in _arms().items()}
"""The known arms, and the class of each."""


def known_arm(name: str) -> Arm:
    """The arm of a name, from its foot to its flange; upper case, spaces and - _ . are ignored."""
    names = [known for known in ARM_NAMES if _plain(known) == _plain(name)]
    if not names:
        raise InputError(
            f"arm {name!r} is not known; give a URDF, or one of {', '.join(ARM_NAMES)}"
        )
    arm = _arms()[names[0]]
    a, alpha, d, theta = np.array(arm["links"], dtype=float).T
    turns = Rotation.from_euler(
        "XZ",
        np.stack([alpha, theta], 1),
        degrees=True,
    )
    tilt = np.radians(alpha)
    links = np.tile(np.eye(4), (len(a), 1, 1))
    links[:, :3, :3] = turns.as_matrix()
    shifts = [a, -d * np.sin(tilt), d * np.cos(tilt)]
    links[:, :3, 3] = np.stack(shifts, 1) / 1000
    lower, upper = np.transpose(arm["limits"])
    ranges = np.stack([lower, arm["rest"], upper], 1) * np.pi / 180
    z = np.array([0, 0, 1.0])
    chain = [
        MovingJoint(
            link,
            z,
            True,
            i,
        )
        for i, link in enumerate(links[:-1])
    ]
    for sliding in arm.get("sliding", ()):
        chain[sliding] = chain[sliding]._replace(rotates=False)
        ranges[sliding] *= 0.18 / np.pi
    joints = tuple(f"joint_{i + 1}" for i in range(len(chain)))
    # Some controllers have their base frame where the first two axes meet.
    heights = {0.0, arm.get("controller_mm", 0) / 1000}
    assumed = tuple(product(heights, _TOOLS_M))
    return Arm(
        joints,
        tuple(chain),
        links[-1],
        ranges,
        names[0],
        assumed,
    )


def _plain(name: str) -> str:
    return re.sub(
        "[-_. ]",
        "",
        name.lower(),
    )
