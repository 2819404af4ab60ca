"""Mistakes of joint values are named by the motions between images, and right ones are not."""

import re
from collections.abc import Callable, Sequence

import numpy as np
import pytest

from evercal.robot.joint_agreement import OFFSET, JointTest
from evercal.robot.joint_search import JointVerdict, joint_search
from evercal.robot.mount import EYE_IN_HAND, EYE_TO_HAND, Mount
from evercal.typing import Array

from .arms import ARMS, joint_values, motions

Change = Callable[[Array], Array]


def sense(*joints: int) -> Change:
    def changed(values: Array) -> Array:
        values = values.copy()
        values[:, joints] *= -1
        return values

    return changed


def zero(joint: int, degrees: float) -> Change:
    def changed(values: Array) -> Array:
        values = values.copy()
        values[:, joint] += np.deg2rad(degrees)
        return values

    return changed


def coupled(joint: int, other: int, factor: float) -> Change:
    def changed(values: Array) -> Array:
        values = values.copy()
        values[:, joint] += factor * values[:, other]
        return values

    return changed


def order(*columns: int) -> Change:
    return lambda values: values[:, columns]


def both(first: Change, second: Change) -> Change:
    return lambda values: second(first(values))


def units(*factors: float) -> Change:
    return lambda values: values * np.array(factors)


def percent(low: Sequence[float], high: Sequence[float]) -> Change:
    lower = np.deg2rad(low)
    return lambda v: 200 * (v - lower) / (np.deg2rad(high) - lower) - 100


DEG = 180 / np.pi
STEPS = np.array([1.0] * 3 + [4096 / 2 / np.pi] * 3)
LOW = [-100, -110, -90, -105, -150]
HIGH = [120, 95, 100, 90, 150]
SINGLE = {
    "sense 1": ("cobot", sense(0), ["joint_1 counts in the other sense"]),
    "sense 5": ("cobot", sense(4), ["joint_5 counts in the other sense"]),
    "sense of the wrist": ("hobby", sense(3), ["wrist_flex counts in the other sense"]),
    "sense of a seventh": ("panda", sense(3), ["panda_joint4 counts in the other sense"]),
    "sense in a scara": ("scara", sense(1), ["joint_2 counts in the other sense"]),
    "sense of a slide": ("gantry", sense(0), ["joint_1 counts in the other sense"]),
    "sense of a lift": ("gantry", sense(2), ["joint_3 counts in the other sense"]),
    "zero by 90": ("cobot", zero(1, 90), ["zero of joint joint_2 is (8|9)"]),
    "zero of the lift": ("hobby", zero(1, -90), ["zero of joint shoulder_lift is (8|9)"]),
    "zero by 45": ("panda", zero(5, 45), ["zero of joint panda_joint6 is 4"]),
    "zero by 20": ("welder", zero(2, 20), ["zero of joint joint_3 is (1|2)"]),
    "J3 with J2": ("welder", coupled(2, 1, 1), ["joint_3 is coupled to joint_2: .*minus"]),
    "J3 against J2": ("welder", coupled(2, 1, -1), ["joint_3 is coupled to joint_2: .*plus"]),
    "T with B": ("welder", coupled(5, 4, 1), ["joint_6 is coupled to joint_5"]),
    "two columns": ("panda", order(0, 1, 3, 2, 4, 5, 6), ["panda_joint3, panda_joint4 .*order"]),
    "from the tip": ("welder", order(5, 4, 3, 2, 1, 0), ["another order"]),
    "degrees": ("panda", units(*[DEG] * 7), ["^values are in degrees$"]),
    "mixed units": ("welder", units(1, 1, 1, DEG, DEG, DEG), ["joint_6 are in degrees"]),
    "steps": ("hobby", lambda v: 2048 + v * 4096 / 2 / np.pi, ["steps of the motor"]),
    "steps beside slides": ("gantry", lambda v: v * STEPS + [0, 0, 0, 2048, 2048, 2048],
                            ["joints joint_4, joint_5, joint_6 are in steps"]),
    "zero and sense": ("hobby", both(sense(4), zero(2, -90)), ["elbow_flex is", "wrist_roll"]),
    "coupling and sense": ("welder", both(sense(5), coupled(2, 1, 1)), ["joint_3 is", "joint_6"]),
    "normalised": ("hobby", percent(LOW, HIGH), ["values are normalised"]),
}  # fmt: skip
"""Arm, what is done to its values, and what is said."""
QUICK = ("sense of a slide", "J3 with J2")


def verdict(kind: str, change: Change, seed: int, mount: Mount) -> JointVerdict:
    rng = np.random.default_rng(seed)
    arm = ARMS[kind]
    values = joint_values(arm, rng)
    seen = motions(arm, values, rng, mount)
    return joint_search(JointTest(arm, change(values), seen, mount))


def assert_named(case: str, mount: Mount = EYE_IN_HAND) -> None:
    kind, change, expected = SINGLE[case]
    found = verdict(kind, change, 3, mount)
    assert not found.agrees
    # Turns about one axis may have several causes.
    assert len(found.readings) == 1 or kind == "scara"
    said = ["\n".join(one.mistakes) for one in found.readings]
    named = [text for text in said if text.count("\n") + 1 == len(expected)]
    for pattern in expected:
        assert any(re.search(pattern, text, re.MULTILINE) for text in named)


@pytest.mark.parametrize("case", QUICK)
def test_a_mistake_is_named_with_its_joint(case: str) -> None:
    assert_named(case)


@pytest.mark.slow("robot")
@pytest.mark.parametrize("case", sorted(SINGLE.keys() - set(QUICK)))
def test_more_mistakes_are_named(case: str) -> None:
    assert_named(case)


def test_a_fixed_camera_that_observes_a_held_thing_names_it_as_well() -> None:
    assert_named("sense 5", EYE_TO_HAND)


@pytest.mark.parametrize("kind", sorted(ARMS))
def test_right_values_are_not_accused(kind: str) -> None:
    """Neither with offsets of some degrees, nor with other zeros of the first and the last joint:
    they turn base and camera."""
    size = np.where(ARMS[kind].rotates(), np.deg2rad(2.0), 0.002)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        offsets = rng.normal(0, size)
        ends = size * 0
        if ARMS[kind].rotates()[[0, -1]].all():
            ends[[0, -1]] = 1.0
        found = verdict(kind, lambda v, o=offsets + ends: v + o, seed, EYE_IN_HAND)
        assert found.agrees


@pytest.mark.slow("robot")
def test_values_of_other_images_are_not_explained() -> None:
    found = verdict("hobby", lambda v: v[::-1], 1, EYE_IN_HAND)
    assert not found.agrees
    assert not found.readings


def test_the_reading_gives_the_true_values() -> None:
    rng = np.random.default_rng(5)
    arm = ARMS["hobby"]
    values = joint_values(arm, rng)
    seen = motions(arm, values, rng)
    stated = both(sense(3), zero(1, 0))(values)
    (one,) = joint_search(JointTest(arm, stated, seen, EYE_IN_HAND)).readings
    read = stated @ one.reading[:, :OFFSET].T + one.reading[:, OFFSET]
    np.testing.assert_allclose(read, values, atol=1e-9)
