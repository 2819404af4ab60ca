"""Every convention against elementary rotations, and numbers that do not look like their units."""

import math
from collections.abc import Callable
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.linalg import expm

from evercal.choices import ConventionName
from evercal.geometry import SE3, pose_distance
from evercal.recordings.poses.conventions import (
    CONVENTIONS,
    VENDORS,
    asking_for,
    numbers_from_poses,
    pose_convention,
    poses_from_numbers,
)
from evercal.recordings.poses.pose_units import checked_poses
from evercal.typing import Array


def of_vector(x: float, y: float, z: float) -> Array:
    return np.asarray(
        expm(np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])), dtype=np.float64
    )


def of_quaternion(w: float, x: float, y: float, z: float) -> Array:
    return of_vector(*(2 * np.arccos(w) / math.sqrt(1 - w * w) * np.array([x, y, z])))


def fixed(axes: str, unit: float = 1.0) -> Callable[..., Array]:
    def rotation(*angles: float) -> Array:
        vectors = [
            unit * a * np.eye(3)["xyz".index(axis)]
            for axis, a in zip(axes, angles, strict=True)
        ]
        first, second, third = (of_vector(*vector) for vector in vectors)
        return third @ second @ first

    return rotation


def moving(axes: str, unit: float = 1.0) -> Callable[..., Array]:
    return lambda a, b, c: fixed(axes[::-1], unit)(c, b, a)


DEGREE = math.pi / 180
ROTATIONS: dict[str, Callable[..., Array]] = {
    "wxyz": of_quaternion,
    "xyzw": lambda x, y, z, w: of_quaternion(w, x, y, z),
    "tum": lambda x, y, z, w: of_quaternion(w, x, y, z),
    "abb": of_quaternion,
    "ur": of_vector,
    "rpy": fixed("xyz"),
    "kuka": moving("zyx", DEGREE),
    "fanuc": fixed("xyz", DEGREE),
    "yaskawa": fixed("xyz", DEGREE),
    "staubli": moving("xyz", DEGREE),
    "kawasaki": moving("zyz", DEGREE),
    **{n: fixed(n[6:]) for n in CONVENTIONS if n.startswith("fixed_")},
    **{n: moving(n[7:]) for n in CONVENTIONS if n.startswith("moving_")},
}
MILLIMETRES = {"abb", "kuka", "fanuc", "yaskawa", "staubli", "kawasaki"}


def twin(name: str, numbers: Array) -> Array:
    """The matrix that numbers mean, in metres."""
    if name in ("matrix", "franka"):
        return numbers.reshape(4, 4, order="C" if name == "matrix" else "F")
    matrix = np.eye(4)
    matrix[:3, :3] = ROTATIONS[name](*numbers[3:])
    matrix[:3, 3] = numbers[:3] * (0.001 if name in MILLIMETRES else 1.0)
    return matrix


def drawn(seed: int) -> SE3:
    rng = np.random.default_rng(seed)
    return SE3(rng.normal(size=4), rng.normal(size=3))


seeds = st.integers(0, 2**32 - 1)
names = st.sampled_from(sorted(CONVENTIONS))


@given(st.sampled_from(sorted(ROTATIONS)), seeds)
@settings(max_examples=200)
def test_read_poses_agree_with_their_numbers(name: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    convention = CONVENTIONS[name]
    rotation = rng.normal(size=convention.counts[-1] - 3)
    if convention.has_angles:
        rotation *= 90 if convention.degrees else 1.5
    else:
        rotation /= np.linalg.norm(rotation)
    numbers = np.concatenate([rng.normal(size=3) * 100, rotation])
    read = poses_from_numbers(numbers, convention)
    np.testing.assert_allclose(read.matrix(), twin(name, numbers), atol=1e-12)


@given(
    names,
    seeds,
    st.sampled_from(["", ":m", ":mm"]),
    st.sampled_from(["", ":inverse"]),
    st.sampled_from(["", ":opengl"]),
)
@settings(max_examples=200)
def test_modifiers_change_unit_direction_and_axes(
    name: str, seed: int, unit: str, inverse: str, opengl: str
) -> None:
    convention = pose_convention(name + unit + inverse + opengl)
    rng = np.random.default_rng(seed)
    poses = SE3(rng.normal(size=(5, 4)), rng.normal(size=(5, 3)))
    numbers = numbers_from_poses(poses, convention)
    back = poses_from_numbers(numbers, convention)
    assert np.max(pose_distance(back, poses)) < 1e-12
    # A matrix twin: axes flipped first, then inverted, then scaled.
    expected = poses[0].matrix() @ (np.diag([1, -1, -1, 1]) if opengl else np.eye(4))
    expected = np.linalg.inv(expected) if inverse else expected
    implied = 0.001 if name in MILLIMETRES else 1.0
    scale = {"": implied, ":m": 1.0, ":mm": 0.001}[unit]
    expected_numbers = numbers[0].copy()
    expected_numbers[
        {"matrix": [3, 7, 11], "franka": [12, 13, 14]}.get(name, [0, 1, 2])
    ] *= scale / implied
    np.testing.assert_allclose(twin(name, expected_numbers), expected, atol=1e-12)


@pytest.mark.parametrize("name", ["rpy", "kuka", "fanuc", "yaskawa", "staubli"])
@pytest.mark.parametrize("middle", [90.0, -90.0, 90 - 1e-6, 90 - 1e-8])
def test_gimbal_lock_keeps_the_rotation(name: str, middle: float) -> None:
    convention = pose_convention(f"{name}:deg")
    pose = poses_from_numbers([0, 0, 0, 20.0, middle, 50.0], convention)
    again = poses_from_numbers(numbers_from_poses(pose, convention), convention)
    assert pose_distance(again, pose)[1] < 3e-7


def test_editors_know_the_names_of_all_conventions() -> None:
    any_axes = ("fixed_", "moving_")
    names = {name for name in CONVENTIONS if not name.startswith(any_axes)}
    assert {*get_args(ConventionName)} == names | VENDORS.keys()


def test_quaternions_are_written_with_positive_w() -> None:
    pose = SE3(np.array([-0.5, 0.5, 0.5, 0.5]), np.zeros(3))
    assert numbers_from_poses(pose, CONVENTIONS["xyzw"])[6] == 0.5


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("euler", "is not known; give the convention NAME, such as xyzw"),
        ("kuka:cm", "'cm' is not one of m, mm, rad, deg, inv"),
        ("wxyz:deg", "'deg' is not one of m, mm, inverse, opengl"),
        ("kuka:m:mm", "repeats a modifier"),
        ("kuka:deg:rad", "repeats a modifier"),
        ("matrix:inverse:inverse", "repeats a modifier"),
    ],
)
def test_unknown_names_are_refused(name: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        pose_convention(name)


def rows(name: str) -> Array:
    """Poses as of an arm: half a metre from its base."""
    rng = np.random.default_rng(5)
    translation = rng.uniform(0.2, 0.8, (6, 3))
    return numbers_from_poses(
        SE3(rng.normal(size=(6, 4)), translation), pose_convention(name)
    )


@pytest.mark.parametrize(
    ("written", "read", "remedy"),
    [
        ("wxyz:mm", "wxyz", "look like millimetres; give --robot-convention wxyz:mm"),
        (
            "matrix:mm",
            "matrix",
            "look like millimetres; give --robot-convention matrix:mm",
        ),
        ("franka:mm", "franka:inverse", "give --robot-convention franka:inverse:mm"),
        ("kuka:m", "kuka", "look like metres; give --robot-convention kuka:m"),
        ("rpy:deg", "rpy", "look like degrees; give --robot-convention rpy:deg"),
        ("ur:deg", "ur", "look like degrees; give --robot-convention ur:deg"),
        ("fanuc:rad", "fanuc", "look like radians; give --robot-convention fanuc:rad"),
    ],
)
def test_other_units_are_refused_unless_stated(
    written: str, read: str, remedy: str
) -> None:
    with (
        pytest.raises(ValueError, match=remedy),
        asking_for("--robot-convention"),
    ):
        checked_poses(rows(written), pose_convention(read))
    stated = remedy.split("--robot-convention ")[1]
    checked_poses(rows(written), pose_convention(stated))
    units = {"mm": ":m", "m": ":mm", "deg": ":rad", "rad": ":deg"}[
        stated.split(":")[-1]
    ]
    checked_poses(rows(written), pose_convention(read + units))


@pytest.mark.parametrize(("name", "factor"), [("xyzw", 1000.0), ("abb", 0.001)])
def test_poses_in_mixed_units_are_named(name: str, factor: float) -> None:
    numbers = rows(name)
    numbers[[1, 4], :3] *= factor
    with pytest.raises(
        ValueError, match=r"poses 2, 5 .*millimetres and metres may be mixed"
    ):
        checked_poses(numbers, CONVENTIONS[name])


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("wxyz", lambda n: n[:, :6], "has 7 numbers .* got 6"),
        (
            "wxyz",
            lambda n: n * np.where(np.arange(7) > 2, 2, 1),
            "pose 1 .* not of length 1",
        ),
        (
            "wxyz",
            lambda n: np.r_[n[:2], n[2:] * 1.2],
            r"pose 3 \(and 3 more\): .*length 1",
        ),
        ("ur", lambda n: np.where(np.arange(6) == 4, np.nan, n), "inf or nan"),
        (
            "matrix",
            lambda n: n.reshape(-1, 4, 4).swapaxes(1, 2).reshape(-1, 16),
            "franka",
        ),
        (
            "franka",
            lambda n: n.reshape(-1, 4, 4).swapaxes(1, 2).reshape(-1, 16),
            "matrix",
        ),
        ("matrix", lambda n: n + np.eye(4).ravel() * 0.1, "last row"),
        (
            "matrix",
            lambda n: n * np.where(np.arange(16) % 4 < 3, 1.1, 1),
            "is no rotation",
        ),
        (
            "matrix",
            lambda n: n * np.where(np.arange(16) % 4 == 0, -1, 1),
            "is no rotation",
        ),
    ],
)
def test_invalid_numbers_are_refused(
    name: str, change: Callable[[Array], Array], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        poses_from_numbers(change(rows(name)), CONVENTIONS[name])
