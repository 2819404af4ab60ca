"""`benchmarks shared-errors`: arms drawn as stated, answers, rows."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.pair_answers import Recording
from benchmarks.shared_errors import (
    ARMS,
    LEFT_OUT,
    Condition,
    arm_named,
    drawn,
    knowledge,
    measured,
    parts,
    summary,
)
from evercal.geometry import SE3, pose_distance
from evercal.robot.mount import MountName


def wobble(recording: Recording) -> np.ndarray:
    """Mean distance of the boards, or cameras, by each pose from their middle: mm and deg."""
    robot, camera, truth = (
        SE3.from_matrix(np.array(recording[name]))
        for name in ("robot", "camera", "truth")
    )
    if recording["mount"] == "eye_in_hand":
        fixed = robot @ truth @ camera
    else:
        fixed = robot.inverse() @ truth @ camera
    metres, radians = pose_distance(fixed[0], fixed[1:])
    return np.array([1000 * metres.mean(), np.rad2deg(radians.mean())])


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("mount", ["eye_in_hand", "eye_to_hand"])
def test_an_arm_without_offsets_obeys_the_equation(name: str, mount: MountName) -> None:
    exact = Condition(name, "exact links", 0.0, 8, mount)
    mm, deg = wobble(drawn(exact, 0))
    # Joints scatter by 0.01 deg, a board by 0.1 mm.
    assert mm < 1
    assert deg < 0.1
    offset = replace(exact, deg=1.0)
    mm_off, deg_off = wobble(drawn(offset, 0))
    assert mm_off > 3 * mm
    assert deg_off > 3 * deg


def test_naming_the_arm_gives_the_smaller_error_and_rows_are_summaries() -> None:
    condition = Condition("ur5e", "exact links", 0.2, 12)
    alone, named = (
        summary(measured(known, condition, 2, Path()))
        for known in ("independent", "named")
    )
    assert float(named["median deg"]) < float(alone["median deg"])
    assert float(named["mean d2"]) < float(alone["mean d2"])
    assert summary([{"refused": "x"}]) == {"draws": 1, "refused": 1}


def test_kinds_are_left_out_one_by_one() -> None:
    condition = Condition("ur5e", poses=8)
    usual = json.dumps(measured("unnamed", condition, 1, Path())[0]["mm"])
    for kind in LEFT_OUT[:1]:
        rows = measured(f"without {kind}", condition, 1, Path())
        assert json.dumps(rows[0]["mm"]) != usual


def test_every_cell_can_be_drawn() -> None:
    seen = set()
    for cells in parts().values():
        for condition, names in cells:
            if (condition.arm, condition.errors) in seen:
                continue
            seen.add((condition.arm, condition.errors))
            recording = drawn(condition, 0)
            assert len(recording["robot"]) == condition.poses
            assert all(knowledge(name, condition) for name in names)
    assert len(arm_named("scara").joints) == 6
