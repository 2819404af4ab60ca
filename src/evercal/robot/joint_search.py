"""`joint_search`: the reading of joint values that explains the motions between images.

Tried are the sense and the zero of each joint, units, the order of columns, couplings of joints
and normalised values. Each round adds a mistake to the best readings of the last one.
"""

import re
from itertools import combinations
from typing import NamedTuple

import numpy as np

from evercal.robot.arm import Arm
from evercal.robot.joint_agreement import FREEDOM, OFFSET, SPREAD, JointTest
from evercal.robot.joint_map import UNITS
from evercal.typing import Array, IntArray, Strings

AGREE_DEG = 2.0
"""Median difference of rotations up to which joint values agree with the images."""
_FOUND_DEG = 3.0
"""The same of a reading that explains them."""
_DIRECTION_DEG = 10.0
"""The same of directions of translations."""
_BETTER = 0.6
"""Cost of a reading that explains the images, relative to that of the stated one."""
_OF_MISTAKE = 0.01
"""Cost of a mistake."""
_EQUAL = 0.003
"""Difference of costs up to which readings fit equally."""
_SMALL = np.deg2rad(3.0)
"""Standard deviation of offsets that are no mistake, radians, or 5 times metres."""
_ANY = 5.0
"""Standard deviation of an unknown offset, radians."""
_RANGES = 0.5
"""Standard deviation of the logarithm of an unknown range."""
_LARGE_DEG = 10.0
"""Offset above which a zero is a mistake."""
_WIDE = 0.35
"""Residual at which the cost of a first reading saturates."""
_CLOSE = 0.12
"""The same for refined readings."""
_REFINED = 16
"""Number of readings that are refined."""
_ROUNDS = 3
"""Largest number of mistakes, besides the unit."""
_COUPLED = 2
"""Largest distance along the arm of joints that are coupled."""
_TURN = 2 * np.pi
_ZEROS = _TURN / 8 * np.arange(1, 8)
"""Zeros that are tried."""
_LEAST = 0.3
"""Largest angle of an arm, at least, radians."""
_SPAN = 100.0
"""Normalised values are between minus and plus this."""
_STEPS = "in steps of the motor, 4096 a turn"
_NORMALISED = "normalised, neither radians nor degrees"
_UNITS = {"": 1.0, "in degrees": UNITS["deg"], _STEPS: UNITS["steps"]}
"""Factors to radians by words; others are those of normalised values."""


class Explained(NamedTuple):
    """A reading of joint values beside the images."""

    reading: Array
    """(k, k + 3), see `JointTest`."""
    error_deg: float
    """Median difference of rotations."""
    direction_deg: float
    """The same of directions of translations."""
    cost: float
    """Of all differences, and of mistakes."""
    mistakes: Strings
    """What differs from the stated reading, as sentences."""


class JointVerdict(NamedTuple):
    """Joint values beside the images."""

    stated: Explained
    """As stated, with offsets of a few degrees."""
    readings: list[Explained]
    """Readings that explain the images far better, and equally well."""

    @property
    def agrees(self) -> bool:
        """Whether the values agree as stated."""
        return not self.readings and self.stated.error_deg < AGREE_DEG


def joint_search(test: JointTest) -> JointVerdict:
    """Compare joint values with images; where they differ, search what explains them."""
    stated = _judged(test, test.refined(_same(test.arm)[None], _CLOSE)[0])
    fits = stated.error_deg < AGREE_DEG and stated.direction_deg < _DIRECTION_DEG
    if fits and not stated.mistakes:
        return JointVerdict(stated, [])
    limit = _BETTER * stated.cost
    if fits or stated.mistakes:
        limit = stated.cost
    changes = _changes(test.arm)
    tried = _bases(test)
    found: list[Explained] = []
    for most in range(1, _ROUNDS + 2):
        rows = np.argsort(test.costs(tried, _WIDE), kind="stable")[:_REFINED]
        tried = tried[rows]
        best = test.refined(test.refined(tried, _WIDE), _CLOSE)
        # Some become alike.
        _, rows = np.unique(np.round(best, 2), axis=0, return_index=True)
        for reading in best[rows]:
            one = _judged(test, reading)
            if one.cost < limit and one.error_deg < _FOUND_DEG:
                found.append(one)
        least = [
            len(one.mistakes) for one in found if one.direction_deg < _DIRECTION_DEG
        ]
        if min(least, default=most + 1) <= most:
            break
        tried = _composed(tried[rows], changes)
    return JointVerdict(stated, _simplest(found))


def _simplest(found: list[Explained]) -> list[Explained]:
    """Those of the fewest mistakes that fit equally well, one of each kind."""
    least = min((one.cost for one in found), default=0.0)
    equal = [one for one in found if one.cost < least + _EQUAL]
    fewest = min(map(_complexity, equal), default=0)
    kinds: dict[str, Explained] = {}
    for one in sorted(equal, key=lambda one: one.cost):
        if _complexity(one) == fewest:
            kind = re.sub(r"is \d+ deg", "", "; ".join(one.mistakes))
            # Small offsets are estimated with the map.
            small = np.abs(one.reading[:, OFFSET]) < np.deg2rad(_LARGE_DEG)
            small &= one.reading[:, FREEDOM] == 0
            one.reading[small, OFFSET] = 0.0
            kinds.setdefault(kind, one)
    return list(kinds.values())


def _complexity(one: Explained) -> float:
    """Number of mistakes. A wrong sense is likelier than a zero that is off by half a turn."""
    return len(one.mistakes) + 0.1 * str(one.mistakes).count("zero")


def _judged(test: JointTest, reading: Array) -> Explained:
    """A reading with what the images and its mistakes cost."""
    mistakes = described(test.arm, reading)
    cost = float(test.costs(reading[None], _CLOSE)[0]) + _OF_MISTAKE * len(mistakes)
    return Explained(
        reading,
        *test.errors_deg(reading),
        cost,
        mistakes,
    )


def _same(arm: Arm) -> Array:
    """The stated reading."""
    count = len(arm.joints)
    same = np.eye(count, count + 3)
    same[:, SPREAD] = np.where(arm.rotates(), _SMALL, _SMALL / 5) * arm.free()
    return same


def _composed(first: Array, second: Array) -> Array:
    """All readings of `first`, each followed by all changes of `second`."""
    change = second[:, None]
    composed = change[..., :OFFSET] @ first
    composed[..., OFFSET] += change[..., OFFSET]
    composed[..., SPREAD:] = np.maximum(change[..., SPREAD:], first[..., SPREAD:])
    return composed.reshape(-1, *first.shape[1:])


def _changes(arm: Arm) -> Array:
    """The stated reading, and all changes of one kind."""
    same = _same(arm)
    count = len(same)
    changes = [same]

    def change(
        joint: int,
        column: int,
        factor: float,
        offset: float = 0.0,
    ) -> None:
        changed = same.copy()
        changed[joint, column] = factor
        changed[joint, OFFSET] = offset
        if offset:
            changed[joint, SPREAD] = _ANY
        changes.append(changed)

    turning = arm.rotates() & arm.free()
    for joint in range(count):
        change(joint, joint, -1.0)
        for angle in _ZEROS * turning[joint]:
            change(
                joint,
                joint,
                1.0,
                angle,
            )
        for other in range(max(joint - _COUPLED, 0), min(joint + _COUPLED + 1, count)):
            if other != joint:
                change(joint, other, 1.0)
                change(joint, other, -1.0)
    orders = [np.arange(count)[::-1]]
    for first, second in combinations(range(count), 2):
        order = np.arange(count)
        order[[first, second]] = second, first
        orders.append(order)
    for order in orders:
        changed = same.copy()
        changed[:, :OFFSET] = same[order, :OFFSET]
        changes.append(changed)
    return np.array(changes)


def _bases(test: JointTest) -> Array:
    """Readings in which all values have a unit that makes them angles, or are normalised."""
    same = _same(test.arm)
    turns = test.arm.rotates()
    free = turns & test.arm.free()
    sizes = np.abs(test.values).max(0) * turns
    lower, middle, upper = np.broadcast_to(test.arm.ranges, (len(same), 3)).T
    normal = np.minimum((upper - lower) / 2, _TURN / 2) / _SPAN
    degrees = UNITS["deg"]
    bases = [same]
    for scale, zero, freedom in (
        (degrees, 0.0, 0.0),
        (np.where(sizes > _TURN, degrees, 1.0), 0.0, 0.0),
        # The zero of a motor is in the middle of its steps.
        (UNITS["steps"], -_TURN / 2, 0.0),
        (1 / degrees, 0.0, 0.0),
        (normal, middle * free, _RANGES),
    ):
        if _LEAST < (sizes * scale).max() < 2 * _TURN:
            base = same.copy()
            base[:, :OFFSET] *= np.where(turns, scale, 1.0)[:, None]
            base[:, OFFSET] = zero * turns
            base[:, FREEDOM] = freedom * turns
            base[free & (freedom > 0), SPREAD] = _ANY
            bases.append(base)
    return np.array(bases)


def described(arm: Arm, reading: Array) -> Strings:
    """What a reading of joint values changes, a sentence each."""
    matrix = reading[:, :OFFSET]
    sizes = np.abs(matrix)
    # A value of its own column counts more than those that are coupled to it.
    columns = (sizes + np.diag(np.diag(sizes))).argmax(1)
    moved = np.flatnonzero(columns != np.arange(len(columns)))
    found = []
    if moved.size:
        found.append(f"the columns of joints {_names(arm, moved)} are in another order")
    factors = sizes.max(1)
    known = [
        np.isclose(
            factors,
            unit,
            0.01,
            0.0,
        )
        for unit in _UNITS.values()
    ]
    units = np.select(known, [*_UNITS], _NORMALISED)
    normalised = _NORMALISED in units
    if normalised:
        units[:] = _NORMALISED
    for words in dict.fromkeys(units[units != ""].tolist()):
        joints = np.flatnonzero(units == words)
        whose = "values are"
        if joints.size < len(units):
            whose = f"values of joints {_names(arm, joints)} are"
        found.append(f"{whose} {words}")
    zeros = reading[:, OFFSET] + _TURN / 2 * (units == _STEPS)
    far = np.rad2deg(np.abs((zeros + np.pi) % _TURN - np.pi))
    for i, joint in enumerate(arm.joints):
        main = matrix[i, columns[i]]
        if main < 0:
            found.append(f"joint {joint} counts in the other sense than the URDF")
        coupled = matrix[i] / main
        coupled[columns[i]] = 0
        for other in np.flatnonzero(np.abs(coupled) > 0.5):
            word = "minus" if coupled[other] < 0 else "plus"
            by = arm.joints[other]
            found.append(
                f"joint {joint} is coupled to {by}: it stands at its value {word} that of {by}"
            )
        if far[i] > _LARGE_DEG and not normalised:
            found.append(f"the zero of joint {joint} is {far[i]:.0f} deg off")
    return tuple(found)


def _names(arm: Arm, joints: IntArray) -> str:
    return ", ".join(arm.joints[i] for i in joints)
