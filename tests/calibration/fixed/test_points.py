"""Fixed cameras by points that the robot knows: right, wide or refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evercal.calibration.fixed.point_pairs import solve_points
from evercal.calibration.fixed.touched_picks import solve_picks
from evercal.calibration.picked_points import (
    PickedPoint,
    paired_positions,
    read_points,
    read_positions,
)
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.typing import Array

CAMERA = Camera(640, 480, 620, 621, 322.3, 238.1, (0.02, 0.0, 0.0, 0.0, 0.0))
TRUTH = SE3.exp([0.5, 0.1, 0.8, 0, 0, 0]) @ SE3.exp([0, 0, 0, 2.6, 0.1, 0.2])


def points(count: int, seed: int, flat: bool = False) -> tuple[Array, Array]:
    """Points in the camera frame and in the base."""
    rng = np.random.default_rng(seed)
    seen = rng.uniform([-0.22, -0.15, 0.6], [0.22, 0.15, 1.0], (count, 3))
    base = TRUTH.apply(seen)
    if flat:
        base[:, 2] = 0.05
        seen = TRUTH.inverse().apply(base)
    return seen, base


def paired(count: int, seed: int, wreck: Callable[[Array], Array]) -> float:
    """Squared Mahalanobis distance of the answer to points of a depth camera."""
    rng = np.random.default_rng(seed)
    seen, base = points(count, seed)
    seen = seen + rng.normal(0, 0.002, seen.shape) * [0.4, 0.4, 1]
    names = tuple(map(str, range(count)))
    return solve_points(names, wreck(base), seen).uncertain_pose.squared_mahalanobis(
        TRUTH
    )


def one_off(base: Array) -> Array:
    base[0] += [0.04, 0.02, -0.05]
    return base


def swapped(base: Array) -> Array:
    base[[0, 1]] = base[[1, 0]]
    return base


@pytest.mark.parametrize(
    ("count", "wreck"), [(20, np.copy), (4, np.copy), (12, one_off), (16, swapped)]
)
def test_points_of_a_depth_camera_place_it(
    count: int, wreck: Callable[[Array], Array]
) -> None:
    assert sum(paired(count, seed, wreck) < 12.6 for seed in range(6)) >= 5


@pytest.mark.parametrize("seed", range(4))
def test_the_base_may_be_behind_the_camera(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = SE3.exp([0.6, 0.2, 0.5, 0, 0, 0]) @ SE3.exp([0, 0, 0, 0.3 * seed, 1.6, 0])
    seen = rng.uniform([-0.22, -0.15, 0.6], [0.22, 0.15, 1.0], (8, 3))
    names = [f"p{i}" for i in range(8)]
    known = dict(zip(names, truth.apply(seen), strict=True))
    pixels = CAMERA.project(seen) + rng.normal(0, 0.5, (8, 2))
    picks = [
        PickedPoint("a.png", name, pixel)
        for name, pixel in zip(names, pixels, strict=True)
    ]
    found = solve_picks(known, picks, CAMERA, 5e-4, 1.0)
    assert truth.inverse().translation_m[2] < 0
    assert found.uncertain_pose.squared_mahalanobis(truth) < 16.8


@pytest.mark.parametrize(
    ("wreck", "message"),
    [
        (lambda base: 1000 * base, "1000 times|1[0-9]{3} times|99[0-9]"),
        (lambda base: base * [1, -1, 1], "mirrored"),
        (lambda base: base[::-1], "same row of both"),
        (lambda base: np.linspace([0, 0, 0], [0.3, 0.1, 0], 12), "one line"),
        (lambda base: base + np.sin(np.arange(36).reshape(12, 3)) / 15, "a marker"),
    ],
)
def test_points_that_no_motion_explains_are_refused(
    wreck: Callable[[Array], Array], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        paired(12, 1, wreck)


@pytest.mark.parametrize("seed", range(4))
def test_few_points_of_a_mirrored_axis_are_refused(seed: int) -> None:
    with pytest.raises(InputError, match="mirrored"):
        paired(9, seed, lambda base: base * [1, -1, 1])


def test_two_points_are_too_few_and_a_depth_scale_is_named() -> None:
    with pytest.raises(InputError, match="give 3 or more"):
        paired(2, 0, np.copy)
    seen, base = points(20, 3)
    found = solve_points(tuple(map(str, range(20))), base, 1.04 * seen)
    assert "+4.0 % longer" in " ".join(found.checks.warnings or ())


Changed = Callable[[dict[str, Array], list[PickedPoint]], object]


def picked(count: int, seed: int, change: Changed, flat: bool = False) -> float:
    """The same of points that were picked in an image, with other intrinsics than stated."""
    rng = np.random.default_rng(seed)
    seen, base = points(count, seed, flat)
    true = Camera(640, 480, 621.5, 622.5, 323.6, 237, (0.015, 0.0, 0.0, 0.0, 0.0))
    pixels = true.project(seen) + rng.normal(0, 1, (count, 2))
    inside = (pixels > 0).all(1) & (pixels < [639, 479]).all(1)
    known = {f"p{i}": base[i] + rng.normal(0, 5e-4, 3) for i in range(count)}
    picks = [
        PickedPoint("a.png", f"p{i}", pixels[i]) for i in np.flatnonzero(inside)[:12]
    ]
    change(known, picks)
    found = solve_picks(known, picks, CAMERA, 5e-4, 1.0)
    return found.uncertain_pose.squared_mahalanobis(TRUTH)


def nothing(known: dict[str, Array], picks: list[PickedPoint]) -> None:
    """Right input."""


def moved_point(known: dict[str, Array], picks: list[PickedPoint]) -> None:
    known[picks[2].point] += [0.06, -0.05, 0.04]


@pytest.mark.parametrize(
    ("count", "change", "flat"),
    [(8, nothing, False), (12, nothing, True), (10, moved_point, False)],
)
def test_touched_points_in_one_image_place_the_camera(
    count: int, change: Changed, flat: bool
) -> None:
    assert sum(picked(count, seed, change, flat) < 12.6 for seed in range(4)) >= 4


def mirrored(known: dict[str, Array], picks: list[PickedPoint]) -> None:
    for name in known:
        known[name] = known[name] * [1, -1, 1]


def turned_names(known: dict[str, Array], picks: list[PickedPoint]) -> None:
    values = [*known.values()]
    known.update(zip(known, values[3:] + values[:3], strict=True))


def rows_and_columns(known: dict[str, Array], picks: list[PickedPoint]) -> None:
    picks[:] = [
        p._replace(pixel=p.pixel[::-1]) for p in picks if p.pixel[0] < CAMERA.height
    ]


def on_a_line(known: dict[str, Array], picks: list[PickedPoint]) -> None:
    for i, name in enumerate(known):
        known[name] = np.array([0.3 + 0.02 * i, 0.1, 0.05])


def three(known: dict[str, Array], picks: list[PickedPoint]) -> None:
    del picks[3:]


def other_name(known: dict[str, Array], picks: list[PickedPoint]) -> None:
    picks[0] = picks[0]._replace(point="corner")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (mirrored, "contradict"),
        (turned_names, "contradict"),
        (rows_and_columns, "contradict|outside"),
        (on_a_line, "one line"),
        (three, "give 4 or more"),
        (other_name, "corner was picked and not touched"),
    ],
)
def test_contradictory_picks_are_refused(change: Changed, message: str) -> None:
    with pytest.raises(InputError, match=message):
        picked(9, 2, change)


@pytest.mark.parametrize("seed", [3, 8, 12, 14])
def test_picks_that_agree_only_by_leaving_out_are_refused(seed: int) -> None:
    with pytest.raises(InputError, match="contradict"):
        picked(9, seed, mirrored)


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("x,y,z\n0.1,0.2,0.3\n0.4,0.5,0.6\n", None),
        ("0.1 0.2 0.3\n0.4 0.5 0.6\n", None),
        ("name;x_mm;y_mm;z_mm\na;100;200;300\nb;400;500;600\n", ("a", "b")),
        ("z [m],y [m],x [m]\n0.3,0.2,0.1\n0.6,0.5,0.4\n", None),
        ("# tool\na,0.1,0.2,0.3\nb,0.4,0.5,0.6\n", ("a", "b")),
        ("time,tx,ty,tz\n1,0.1,0.2,0.3\n2,0.4,0.5,0.6\n", None),
        ("p_x,p_y,p_z\n0.1,0.2,0.3\n0.4,0.5,0.6\n", None),
    ],
)
def test_tables_of_positions_are_read(
    tmp_path: Path, text: str, names: tuple[str, ...] | None
) -> None:
    path = tmp_path / "points.csv"
    path.write_text(text)
    found = read_positions(path)
    assert found is not None
    assert found[0] == names
    np.testing.assert_allclose(found[1], [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])


def test_poses_are_no_positions_and_millimetres_are_named(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_text("x,y,z,qw,qx,qy,qz\n1,2,3,1,0,0,0\n")
    assert read_positions(path) is None
    path.write_text("name,x,y,z\na,412.5,20,30\n")
    with pytest.raises(InputError, match=r"412\.5; points are in metres"):
        read_points(path)
    with pytest.raises(InputError, match="x_mm"):
        read_positions(path)


def test_points_are_paired_by_name_else_in_order(tmp_path: Path) -> None:
    first = tmp_path / "first.csv"
    second = tmp_path / "second.csv"
    first.write_text("name,x,y,z\na,1,0,0\nb,2,0,0\nc,3,0,0\n")
    second.write_text("name,x,y,z\nc,0,3,0\na,0,1,0\n")
    names, robot, seen = paired_positions(first, second)
    assert names == ("a", "c")
    np.testing.assert_allclose(robot[:, 0], seen[:, 1])
    second.write_text("x,y,z\n0,3,0\n0,1,0\n")
    with pytest.raises(InputError, match=r"2 points, .*has 3"):
        paired_positions(first, second)
    second.write_text("name,x,y,z\nq,0,3,0\n")
    with pytest.raises(InputError, match="names no point of"):
        paired_positions(first, second)


@pytest.mark.parametrize("change", [{"fx": 500.0, "fy": 501.0}, {"cx": 372.0}])
def test_picks_in_a_volume_contradict_another_camera(change: dict[str, float]) -> None:
    rng = np.random.default_rng(3)
    seen, base = points(20, 3)
    pixels = CAMERA.project(seen) + rng.normal(0, 0.7, (20, 2))
    known = {f"p{i}": point for i, point in enumerate(base)}
    picks = [PickedPoint("a.png", f"p{i}", pixel) for i, pixel in enumerate(pixels)]
    with pytest.raises(InputError, match=r"the picks fit a focal length of 6[0-4]"):
        solve_picks(known, picks, replace(CAMERA, **change), 5e-4, 1.0)
    checks = solve_picks(known, picks, CAMERA, 5e-4, 1.0).checks
    some = solve_picks(known, picks[:6], CAMERA, 5e-4, 1.0).checks
    assert not any("would not show" in text for text in checks.left_open or ())
    assert any("would not show" in text for text in some.left_open or ())


@pytest.mark.parametrize("depth_m", [0.001, 0.003, 0.006])
@pytest.mark.parametrize("count", [6, 12])
def test_right_points_of_a_depth_camera_are_used(count: int, depth_m: float) -> None:
    for seed in range(10):
        rng = np.random.default_rng([seed, count])
        seen, base = points(count, seed)
        noisy = seen + rng.normal(0, depth_m, seen.shape) * [0.4, 0.4, 1]
        found = solve_points(tuple(map(str, range(count))), base, noisy)
        assert all(image.used for image in found.images)


def test_points_behind_a_camera_are_named() -> None:
    seen, base = points(12, 0)
    found = solve_points(tuple(map(str, range(12))), base, seen * [1, -1, -1])
    assert "have negative z, behind it" in " ".join(found.checks.warnings or ())
