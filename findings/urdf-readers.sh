#!/usr/bin/env bash
# Valid URDFs that yourdfpy 0.0.60, urchin 0.0.30 and pin 4.1.0 read in different ways, mostly in
# silence. A slide at 0.1 m whose axis is (0, 0, 2) moves 0.2 m in yourdfpy and 0.1 m in the others.
# quat_xyzw in an origin turns the joint in pin if the robot states version 1.1, and is ignored by the
# others. A joint that mimics a mimic stays at 0 in yourdfpy and urchin, and pin refuses it. A mimic
# that comes before its driver in the chain follows it in yourdfpy and urchin, and pin refuses it.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.4.6 pin==4.1.0 urchin==0.0.30 yourdfpy==0.0.60
cd "$folder"
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
import logging
from importlib.metadata import version

import numpy as np
import pinocchio
import urchin
import yourdfpy

logging.disable()
print(*(f"{name} {version(name)}" for name in ("yourdfpy", "urchin", "pin")), sep=", ")


def by_yourdfpy(values, tip):
    robot = yourdfpy.URDF.load("robot.urdf", load_meshes=False)
    robot.update_cfg(values)
    return robot.get_transform(tip, "a")


def by_urchin(values, tip):
    return urchin.URDF.load("robot.urdf").link_fk(cfg=values, use_names=True)[tip]


def by_pin(values, tip):
    model = pinocchio.buildModelFromUrdf("robot.urdf", mimic=True)
    data, q = model.createData(), np.zeros(model.nq)
    for name, value in values.items():
        q[model.joints[model.getJointId(name)].idx_q] = value
    pinocchio.framesForwardKinematics(model, data, q)
    return data.oMf[model.getFrameId(tip)].homogeneous


def joint(name, ends, more="", kind="revolute", axis="0 0 1", origin='<origin xyz="1 0 0"/>'):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{ends[0]}"/><child link="{ends[1]}"/>'
        f'{origin}<axis xyz="{axis}"/>{more}'
        '<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>'
    )


def answers(title, joints, values, tip, entry, robot='name="r"'):
    links = "".join(f'<link name="{link}"/>' for link in "abcd"[: 1 + len(joints)])
    with open("robot.urdf", "w") as file:
        file.write(f"<robot {robot}>{links}{''.join(joints)}</robot>")
    found = []
    for read in (by_yourdfpy, by_urchin, by_pin):
        try:
            pose = np.asarray(read(values, tip))
            turn = np.arctan2(pose[1, 0], pose[0, 0])
            found.append(round(float(turn if entry == "turn" else pose[2, 3]), 3))
        except ValueError:
            found.append("refused")
    print(f"{title}: {entry} of the last link {found}")
    return found


q, twice = {"j": 0.1}, '<mimic joint="{}" multiplier="2"/>'
slide = [joint("j", "ab", kind="prismatic", axis="0 0 2")]
assert answers("slide along 0 0 2 at 0.1 m", slide, q, "b", "height") == [0.2, 0.1, 0.1]
turn = [joint("j", "ab", axis="0 0 2")]
assert answers("joint about 0 0 2 at 0.1 rad", turn, q, "b", "turn") == [0.1, 0.1, 0.1]
turned = [joint("j", "ab", origin='<origin xyz="1 0 0" quat_xyzw="0 0 0.6 0.8"/>')]
assert answers("quat_xyzw of 1.287 rad", turned, q, "b", "turn") == [0.1, 0.1, 0.1]
new = 'name="r" version="1.1"'
assert answers("the same, version 1.1", turned, q, "b", "turn", new) == [0.1, 0.1, 1.387]
chain = [joint("j", "ab"), joint("m", "bc", twice.format("j")), joint("n", "cd", twice.format("m"))]
found = answers("mimic of a mimic, 0.1 + 0.2 + 0.4 rad", chain, q, "d", "turn")
assert found == [0.3, 0.3, "refused"]
early = [joint("m", "ab", twice.format("j")), joint("j", "bc")]
found = answers("mimic before its driver, 0.2 + 0.1 rad", early, q, "c", "turn")
assert found == [0.3, 0.3, "refused"]
PYTHON
