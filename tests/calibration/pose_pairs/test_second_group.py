"""Rejected rows that agree among themselves."""

import re

import numpy as np
import pytest

from benchmarks.hand_eye import pose
from evercal.calibration.pose_pairs.pairs import PosePairs
from evercal.calibration.pose_pairs.second_group import second_group
from evercal.calibration.pose_pairs.solve import solve_pose_pairs
from evercal.geometry import SE3

from .test_corners import photographed


@pytest.mark.parametrize("what", ["nothing", "base", "camera", "outliers"])
def test_a_group_of_rejected_rows_is_named(what: str) -> None:
    simulated = photographed("eye_in_hand", seed=2, robot_deg=0.01)
    pairs = simulated.pairs
    robot = [pairs.base_from_gripper[i] for i in range(20)]
    rng = np.random.default_rng(3)
    for i in range(13, 20):
        moved = SE3.from_translation((0.02, 0, 0))
        if what == "base":
            robot[i] = moved @ robot[i]
        elif what == "camera":
            robot[i] = robot[i] @ moved
        elif what == "outliers":
            robot[i] = SE3.from_translation(rng.normal(0, 0.02, 3)) @ robot[i]
    noise = rng.normal(0, 1e-4, (20, 3))
    stacked = SE3.stack(robot)
    stacked = pose(stacked.rotation, stacked.translation_m + noise)
    names = tuple(f"row {i + 1}" for i in range(20))
    pairs = PosePairs(names, stacked, pairs.camera_from_board)
    solution = solve_pose_pairs(pairs, "eye_in_hand")
    words = second_group(solution.equation, solution.fit, solution.rows, names)
    if what in ("nothing", "outliers"):
        assert not words
    else:
        assert "7 rejected rows, row 14 to row 20" in words[0]
        assert re.search("moved by (20|19)[.][019] mm", words[0])
        assert what in words[0].split(": ")[1]
    # A step is named once.
    assert len(solution.warnings) == (what in ("base", "camera"))
