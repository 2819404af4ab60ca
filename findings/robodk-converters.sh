#!/usr/bin/env bash
# robodk 6.0.2, robomath: Pose_2_Nachi writes the angle about z first, and Nachi_2_Pose reads the one
# about x first, so a pose that goes through both comes back with another rotation. Staubli_2_Pose
# turns the angles of the list that it is given into radians, so a second call with the same list
# gives another pose. All other pairs give the pose back: Motoman, Fanuc, Techman, KUKA, Comau, UR.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.4.6 robodk==6.0.2
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version

import numpy as np
from robodk import robomath

print("robodk", version("robodk"))
pose = robomath.KUKA_2_Pose([400, 31, 553, 20, -35, 70])


def errors(maker):
    numbers = getattr(robomath, f"Pose_2_{maker}")(pose)
    before = np.round(numbers, 3).tolist()
    back = [getattr(robomath, f"{maker}_2_Pose")(numbers).Rows() for _ in range(2)]
    off = np.abs(np.array(back) - np.array(pose.Rows())).max((1, 2))
    print(f"{maker:8} {before}: off by {off[0]:.2g}, read again by {off[1]:.2g}")
    return off


for maker in "Motoman Fanuc Techman KUKA Comau UR".split():
    assert errors(maker).max() < 1e-9
first, again = errors("Staubli")
assert first < 1e-9 and again > 0.4, "Staubli_2_Pose leaves its list as it is"
assert errors("Nachi").min() > 0.4, "the pair of Nachi has changed"
PYTHON
