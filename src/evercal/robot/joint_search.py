"""`joint_search`: the reading of joint values that explains the motions between images.

Tried are the sense and the zero of each joint, units, the order of columns, couplings of joints
and normalised values; one mistake, two, and then any sense, zero and range of all joints.
"""

import re
from collections.abc import Iterator
from itertools import permutations
from typing import NamedTuple

import numpy as np

from evercal.robot.arm import Arm
from evercal.robot.joint_map import UNITS
from evercal.robot.joint_test import FREEDOM, OFFSET, SPREAD, JointTest
from evercal.typing import Array, Strings

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
_RANDOM = 2000
"""Number of random readings."""
_COUPLED = 2
"""Largest distance along the arm of joints that are coupled."""
_TURN = 2 * np.pi
_SIZES = {
    "rad": (0.0, 2 * _TURN),
    "deg": (_TURN, 2 * 360.0),
    "steps": (360.0, 4096.0),
}
"""Largest value that angles in a unit may have."""
_WORDS = {
    "deg": "in degrees",
    "steps": "in steps of the motor, 4096 a turn",
    "": "normalised, neither radians nor degrees",
}


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
    same = _same(test.arm)
    stated = _judged(test, test.refined(same[None], _CLOSE, 10)[0])
    fits = stated.error_deg < AGREE_DEG and stated.direction_deg < _DIRECTION_DEG
    if fits and not stated.mistakes:
        return JointVerdict(stated, [])
    limit = _BETTER * stated.cost
    if fits or stated.mistakes:
        limit = stated.cost
    found: list[Explained] = []
    for most, tried in _attempts(test):
        simple = False
        for reading in _best(test, tried):
            one = _judged(test, reading)
            if one.cost < limit and one.error_deg < _FOUND_DEG:
                found.append(one)
                explains = one.direction_deg < _DIRECTION_DEG
                simple |= explains and len(one.mistakes) <= most
        if simple:
            break
    least = min((one.cost for one in found), default=0.0)
    equal = [one for one in found if one.cost < least + _EQUAL]
    simplest = min(map(_complexity, equal), default=0)
    distinct: dict[str, Explained] = {}
    for one in sorted(equal, key=lambda one: one.cost):
        if _complexity(one) == simplest:
            kind = re.sub(r"is \d+ deg", "", "; ".join(one.mistakes))
            # Small offsets are estimated with the map.
            small = np.abs(one.reading[:, OFFSET]) < np.deg2rad(_LARGE_DEG)
            small &= ~one.reading[:, FREEDOM].astype(bool)
            one.reading[small, OFFSET] = 0.0
            distinct.setdefault(kind, one)
    return JointVerdict(stated, list(distinct.values()))


def _complexity(one: Explained) -> float:
    """Number of mistakes. A wrong sense is likelier than a zero that is off by half a turn."""
    return len(one.mistakes) + 0.1 * str(one.mistakes).count("zero")


def _attempts(test: JointTest) -> Iterator[tuple[int, Array]]:
    """Readings (h, k, k + 3) with few mistakes first, and the number of mistakes at most."""
    single = _singles(test.arm)
    bases = _bases(test)
    for base in bases:
        yield 1, _composed(base[None], single)
    for base in bases:
        yield 2, _composed(_composed(base[None], single), single)
    for base in bases:
        yield 99, _random(test.arm, base)


def _judged(test: JointTest, reading: Array) -> Explained:
    """A reading with what the images and its mistakes cost."""
    mistakes = described(test.arm, reading)
    (error, direction) = test.errors_deg(reading[None])[0].tolist()
    cost = float(test.costs(reading[None], _CLOSE)[0])
    cost += _OF_MISTAKE * len(mistakes)
    return Explained(reading, error, direction, cost, mistakes)


def _best(test: JointTest, readings: Array) -> Array:
    """The best readings, refined; the first one is among them."""
    costs = test.costs(readings, _WIDE)
    costs[0] = 0.0
    rows = np.argsort(costs, kind="stable")[:_REFINED]
    near = test.refined(readings[rows], _WIDE, 8)
    return test.refined(near, _CLOSE, 8)


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


def _singles(arm: Arm) -> Array:
    """The stated reading, and all changes of one kind."""
    same = _same(arm)
    count = len(same)
    changes = [same]
    turning = arm.rotates() & arm.free()
    for joint in range(count):
        change = same.copy()
        change[joint, joint] = -1
        changes.append(change)
        for angle in _TURN / 8 * np.arange(1, 8) * turning[joint]:
            change = same.copy()
            change[joint, OFFSET] = angle
            change[joint, SPREAD] = _ANY
            changes.append(change)
    for first, second in permutations(range(count), 2):
        change = same.copy()
        if first < second:
            change[[first, second], :OFFSET] = same[[second, first], :OFFSET]
            changes.append(change.copy())
        if abs(second - first) <= _COUPLED:
            for sign in (1, -1):
                change = same.copy()
                change[first, second] = sign
                changes.append(change)
    reversed_order = same.copy()
    reversed_order[:, :OFFSET] = same[::-1, :OFFSET]
    return np.array([*changes, reversed_order])


def _bases(test: JointTest) -> list[Array]:
    """Readings of all values in one unit, as far as the sizes of the values allow it."""
    same = _same(test.arm)
    turns = test.arm.rotates()
    sizes = np.abs(test.values).max(0) * turns
    largest = sizes.max()
    scales = []
    for unit, (least, most) in _SIZES.items():
        if least <= largest < most:
            scales.append(np.where(turns, UNITS[unit], 1.0))
    if largest > _TURN:
        scales.append(np.where(sizes > _TURN, UNITS["deg"], 1.0))
    if largest < 2 * _TURN * UNITS["deg"]:
        scales.append(np.where(turns, 1 / UNITS["deg"], 1.0))
    bases = []
    for scale in scales:
        base = same.copy()
        base[:, :OFFSET] *= scale[:, None]
        # The zero of a motor is in the middle of its steps.
        base[:, OFFSET] = np.where(scale == UNITS["steps"], -_TURN / 2, 0.0)
        bases.append(base)
    lower, middle, upper = np.broadcast_to(test.arm.ranges, (len(same), 3)).T
    for span in (100.0, 1.0):
        if span / 4 < largest < 1.2 * span:
            base = same.copy()
            half = np.minimum((upper - lower) / 2, _TURN / 2) / span
            base[:, :OFFSET] *= np.where(turns, half, 1.0)[:, None]
            base[:, OFFSET] = middle * turns * test.arm.free()
            base[:, SPREAD] = np.where(turns, _ANY * test.arm.free(), same[:, SPREAD])
            base[:, FREEDOM] = _RANGES * turns
            bases.append(base)
    return bases


def _random(arm: Arm, base: Array) -> Array:
    """Readings with random senses, zeros and, where they are unknown, ranges."""
    rng = np.random.default_rng(0)
    free = arm.rotates() & arm.free()
    tried = np.tile(base, (_RANDOM, 1, 1))
    shape = (_RANDOM, len(base), 1)
    tried[..., :OFFSET] *= np.exp(base[:, FREEDOM:] * rng.normal(0, 1, shape))
    tried[..., :OFFSET] *= rng.choice([-1.0, 1.0], shape)
    tried[..., OFFSET] = free * rng.uniform(-np.pi, np.pi, shape[:2])
    tried[..., SPREAD] = np.where(free, _ANY, base[:, SPREAD])
    return tried


def described(arm: Arm, reading: Array) -> Strings:
    """What a reading of joint values changes, a sentence each."""
    matrix = reading[:, :OFFSET]
    sizes = np.abs(matrix)
    # A value of its own column counts more than those that are coupled to it.
    columns = (sizes + np.diag(np.diag(sizes))).argmax(1)
    found = []
    moved = [arm.joints[i] for i, column in enumerate(columns) if i != column]
    if moved:
        found.append(f"the columns of joints {', '.join(moved)} are in another order")
    units: dict[str, list[str]] = {}
    for joint, factor in zip(arm.joints, sizes.max(1), strict=True):
        units.setdefault(unit_of(factor), []).append(joint)
    normalised = "" in units
    if normalised:
        units = {"": list(arm.joints)}
    for unit, joints in units.items():
        if unit in _WORDS:
            whose = "values are"
            if len(joints) < len(columns):
                whose = f"values of joints {', '.join(joints)} are"
            found.append(f"{whose} {_WORDS[unit]}")
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
        middle = _TURN / 2 * ("steps" in units)
        offset = (reading[i, OFFSET] + middle + np.pi) % _TURN - np.pi
        degrees = abs(np.rad2deg(offset))
        if degrees > _LARGE_DEG and not normalised:
            found.append(f"the zero of joint {joint} is {degrees:.0f} deg off")
    return tuple(found)


def unit_of(factor: float) -> str:
    """The unit of a factor to radians; empty if it is none."""
    for unit in _SIZES:
        if abs(np.log(factor / UNITS[unit])) < 0.01:
            return unit
    return ""
