"""`known_arm`: the kinematics of an arm by its name, from its maker's numbers."""

import json
from itertools import product
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from evercal.choices import ArmClass
from evercal.errors import InputError
from evercal.robot.arm import Arm, MovingJoint
from evercal.robot.robot_model import RobotModel
from evercal.typing import JsonObject

_FILE = Path(__file__).with_name("arms.json")
"""Metres and degrees by the name of an arm.

`links` are Craig's Denavit-Hartenberg parameters a, alpha, d, theta up to each joint and up to the
flange; `ranges` a lower limit, a usual value and an upper limit of each joint; `heights` those of
the base frames that may be meant: on the floor, or where the first two axes meet.
"""
_TOOLS_M = (0.0, 0.1, 0.2, 0.3)
"""Lengths of an unknown tool."""

_ARMS: JsonObject = json.loads(_FILE.read_text(encoding="utf-8"))
ARM_NAMES: dict[str, ArmClass] = {name: arm["kind"] for name, arm in _ARMS.items()}
"""The known arms, and the class of each."""
USUAL_RAD: dict[ArmClass, float] = {
    "industrial": 0.001,
    "cobot": 0.0035,
    "hobby": 0.02,
}
"""Usual standard deviation of joint offsets: 0.06, 0.2 and 1.1 deg."""


def known_arm(name: str) -> Arm:
    """The arm of a name, from its foot to its flange; upper case is the same."""
    arm = _ARMS.get(name.lower())
    if arm is None:
        raise InputError(
            f"arm {name!r} is not known; give a URDF, or one of {', '.join(ARM_NAMES)}"
        )
    a, alpha, d, theta = np.transpose(arm["links"])
    turns = Rotation.from_euler(
        "XZ",
        np.stack([alpha, theta], 1),
        degrees=True,
    )
    links = np.tile(np.eye(4), (len(a), 1, 1))
    links[:, :3, :3] = turns.as_matrix()
    links[:, :3, 3] = links[:, :3, 2] * d[:, None]
    links[:, 0, 3] += a
    ranges = np.radians(arm["ranges"])
    chain = []
    for i, link in enumerate(links[:-1]):
        rotates = i not in arm["sliding"]
        chain.append(
            MovingJoint(
                link,
                np.eye(3)[2],
                rotates,
                i,
            )
        )
        if not rotates:
            ranges[i] = arm["ranges"][i]
    return Arm(
        tuple(map(str, range(1, len(links)))),
        tuple(chain),
        links[-1],
        ranges,
        name.lower(),
        tuple(product(arm["heights"], _TOOLS_M)),
    )


def arm_of(stated: str, base: str | None = None, gripper: str | None = None) -> Arm:
    """The arm of a name, or of a URDF file between links; omitted, its root and its only end."""
    if not stated.endswith((".urdf", ".xacro")):
        return known_arm(stated)
    model = RobotModel(stated)
    return model.arm(*model.chosen_links(base, gripper))
