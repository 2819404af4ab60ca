"""Fixed cameras by a board at a known place, and beside each other by a moving board."""

from __future__ import annotations

import tracemalloc
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from evercal.calibration.boards.board import Board
from evercal.calibration.boards.board_poses import board_poses
from evercal.calibration.boards.corners import BoardView
from evercal.calibration.evidence import plus
from evercal.calibration.fixed.rig import solve_rig
from evercal.calibration.fixed.sightings import read_sightings
from evercal.calibration.fixed.still import solve_place
from evercal.calibration.transform_file import read_place
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, UncertainPose
from evercal.typing import Array

CAMERA = Camera(640, 480, 620, 621, 322.3, 238.1, (0.02, 0.0, 0.0, 0.0, 0.0))
TRUE = Camera(640, 480, 621.5, 622, 323.5, 237, (0.015, 0.0, 0.0, 0.0, 0.0))
PLACE = SE3.exp([0.5, 0.1, 0.02, 3.0, 0.2, 0.4])
SIGMA = np.diag(np.repeat(np.square([1e-3, np.deg2rad(0.2)]), 3))
TAG = 0.05 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
GRID = np.array([[0.025 * i, 0.025 * j, 0] for j in range(6) for i in range(9)])


def board_file(
    path: Path, corners: Array, boards: Sequence[SE3], noise: float, columns: int = 9
) -> Path:
    """What `detect` writes of images of a board, with the stated intrinsics."""
    kind = {"kind": "apriltag", "dictionary": "APRILTAG_36h11"}
    if len(corners) > 4:
        kind = {"kind": "chessboard", "columns": columns, "rows": 6}
    rng = np.random.default_rng(len(boards))
    views = {}
    for i, pose in enumerate(boards):
        pixels = TRUE.project(pose.apply(corners))
        pixels = pixels + rng.normal(0, noise, pixels.shape)
        views[f"{i:02d}.png"] = BoardView(corners, pixels)
    board = Board.from_dict({"size_m": 0.025, **kind})
    board_poses(board, CAMERA, views).write(path)
    return path


def seen_at(seed: int, tilt: float = 0.5, metres: float = 0.7) -> SE3:
    rng = np.random.default_rng(seed)
    turn = rng.uniform(0, 2 * np.pi)
    tilted = SE3.exp([0, 0, 0, tilt * np.cos(turn), tilt * np.sin(turn), 0])
    rolled = SE3.exp([0, 0, 0, 0, 0, rng.uniform(0, 6)])
    return SE3.from_translation([0.05, -0.03, metres]) @ tilted @ rolled


@pytest.mark.parametrize(
    ("corners", "images"),
    [(TAG, 1), (TAG, 4), (GRID, 1), (GRID - GRID.mean(0), 3)],
)
def test_a_board_at_a_known_place_calibrates_with_an_honest_sigma(
    tmp_path: Path, corners: Array, images: int
) -> None:
    inside = 0
    for seed in range(3):
        error = np.random.default_rng(seed).normal(size=6) * np.sqrt(np.diag(SIGMA))
        camera_from_board = seen_at(seed)
        file = board_file(
            tmp_path / "left.json", corners, [camera_from_board] * images, 0.15
        )
        place = UncertainPose(PLACE, SIGMA)
        found = solve_place(read_sightings([file])[0], place)
        truth = plus(PLACE, error) @ camera_from_board.inverse()
        inside += found.uncertain_pose.squared_mahalanobis(truth) < 12.6
        assert found.sigma_mm < 30
        assert "turned by 90 or 180 deg" in " ".join(found.checks.left_open or ())
    assert inside == 3


def test_the_accuracy_of_the_place_is_in_the_sigma(tmp_path: Path) -> None:
    file = board_file(tmp_path / "left.json", GRID, [seen_at(1)], 0.1)
    sigmas = []
    for accuracy in ("0.1,0.01", "20,0.01"):
        place = UncertainPose(*read_place("0.5,0.1,0.02,1,0,0,0", accuracy))
        sigmas.append(solve_place(read_sightings([file])[0], place).sigma_mm)
    assert sigmas[1] ** 2 - sigmas[0] ** 2 == pytest.approx(400, rel=0.5)


@pytest.mark.parametrize(
    ("corners", "poses", "columns", "message"),
    [
        (0.15 * TAG, [seen_at(1)], 9, "fit two poses"),
        (0.3 * TAG, [seen_at(2, 0.3, 1.5)], 9, "fit two poses"),
        (GRID, [seen_at(1)], 8, "looks the same after a turn"),
        (GRID, [seen_at(1)], 6, "looks the same after a turn"),
        (GRID, [seen_at(1), seen_at(2), seen_at(3)], 9, "stand still"),
    ],
)
def test_boards_that_leave_the_camera_open_are_refused(
    tmp_path: Path, corners: Array, poses: list[SE3], columns: int, message: str
) -> None:
    file = board_file(tmp_path / "left.json", corners, poses, 0.3, columns)
    with pytest.raises(InputError, match=message):
        solve_place(read_sightings([file])[0], UncertainPose(PLACE, SIGMA))


@pytest.mark.parametrize(
    ("text", "accuracy", "message"),
    [
        ("0.5,0.1,0.02,1,1,0,0", "1,0.2", "unit quaternion"),
        ("500,100,20,1,0,0,0", "1,0.2", "give metres"),
        ("0.5,a,0.02,1,0,0,0", "1,0.2", "unit quaternion"),
        ("0.5,0.1,0.02,1,0,0,0", "1", "millimetres and degrees"),
        ("0.5,0.1,0.02,1,0,0,0", "-1,0.2", "above 0"),
        ("0.5,0.1,0.02", "1,0.2", "no such file|does not exist|missing"),
    ],
)
def test_places_that_are_none_are_refused(
    text: str, accuracy: str, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        read_place(text, accuracy)


CAMERAS = {
    "left": SE3.identity(),
    "right": SE3.exp([0.3, 0.01, 0.05, 0.05, -0.3, 0.02]),
    "front": SE3.exp([-0.35, 0.02, 0.08, -0.1, 0.4, 0.1]),
}


def tables(
    folder: Path, rows: dict[str, range], names: str = "{:03d}.png"
) -> list[Path]:
    """Tables of the poses of a moving board before each camera, 0.5 mm and 0.2 deg off."""
    files = []
    for number, (name, images) in enumerate(rows.items()):
        rng = np.random.default_rng(number)
        lines = ["image,x,y,z,qw,qx,qy,qz"]
        for i in images:
            g = np.random.default_rng(100 + i)
            board = SE3.from_translation([*g.uniform(-0.1, 0.1, 2), 1.0])
            board = board @ SE3.exp([0, 0, 0, *g.normal(0, 0.4, 3)])
            pose = plus(
                CAMERAS[name].inverse() @ board,
                rng.normal(size=6) * np.repeat([5e-4, 3e-3], 3),
            )
            values = [*pose.translation_m, *pose.rotation_wxyz]
            lines.append(f"{names.format(i)}," + ",".join(f"{v:.8f}" for v in values))
        if not names:
            lines = [line.split(",", 1)[1] for line in lines]
        files.append(folder / f"{name}.csv")
        files[-1].write_text("\n".join(lines) + "\n")
    return files


@pytest.mark.parametrize("names", ["{:03d}.png", "", "cam/{:03d}.jpg"])
def test_cameras_are_calibrated_beside_each_other(tmp_path: Path, names: str) -> None:
    rows = {"left": range(12), "right": range(12), "front": range(12)}
    if names:
        rows = {"left": range(10), "right": range(5, 15), "front": range(8, 15)}
    rig = solve_rig(read_sightings(tables(tmp_path, rows, names)))
    assert [pair.second for pair in rig.relative] == ["right", "front"]
    for pair in rig.relative:
        truth = CAMERAS[pair.second]
        assert pair.first_from_second.squared_mahalanobis(truth) < 22.5
        assert pair.first_from_second.sigma_mm < 5
    assert rig.cameras["right"].parent_frame == "left"
    assert rig.relative[0].moments == (5 if names else 12)


def test_a_chain_of_cameras_needs_no_common_view_of_all(tmp_path: Path) -> None:
    rows = {"left": range(8), "right": range(4, 14), "front": range(8, 14)}
    rig = solve_rig(read_sightings(tables(tmp_path, rows)))
    assert rig.relative[1].moments == 0
    pose = rig.relative[1].first_from_second
    assert pose.squared_mahalanobis(CAMERAS["front"]) < 16.8


@pytest.mark.parametrize("outlier", [3, 6])
def test_a_wrong_moment_is_named(tmp_path: Path, outlier: int) -> None:
    files = tables(tmp_path, {"left": range(12), "right": range(12)})
    lines = files[1].read_text().splitlines()
    lines[outlier + 1] = lines[outlier + 1].split(",")[0] + ",0.1,0,0.8,1,0,0,0"
    files[1].write_text("\n".join(lines))
    rig = solve_rig(read_sightings(files))
    rejected = [use.name for use in rig.cameras["right"].images if not use.used]
    assert rejected == [f"{outlier:03d}.png"]
    pose = rig.relative[0].first_from_second
    assert pose.squared_mahalanobis(CAMERAS["right"]) < 16.8


def test_cameras_in_parts_are_named(tmp_path: Path) -> None:
    rows = {"left": range(8), "right": range(4, 12), "front": range(20, 26)}
    files = tables(tmp_path, rows)
    message = r"front \(6 images, first 020.*left \+ right saw .* 0 moments"
    with pytest.raises(InputError, match=message):
        solve_rig(read_sightings(files))
    with pytest.raises(InputError, match="one camera alone"):
        solve_rig(read_sightings(files[:1]))
    with pytest.raises(InputError, match="name one camera twice"):
        read_sightings([files[0], files[0]])


def test_many_moments_take_linear_memory(tmp_path: Path) -> None:
    rows = {"left": range(200), "right": range(200)}
    seen = read_sightings(tables(tmp_path, rows))
    tracemalloc.start()
    try:
        rig = solve_rig(seen)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 20e6
    pose = rig.relative[0].first_from_second
    assert pose.squared_mahalanobis(CAMERAS["right"]) < 16.8


def test_images_without_numbers_are_no_common_moment(tmp_path: Path) -> None:
    rows = {"left": range(4), "right": range(4)}
    files = tables(tmp_path, rows)
    for file in files:
        lines = file.read_text().splitlines()
        for i in range(1, 5):
            name = f"{file.stem}_{'abcd'[i - 1]}.png"
            lines[i] = ",".join([name, *lines[i].split(",")[1:]])
        file.write_text("\n".join(lines))
    with pytest.raises(InputError, match="at 0 moments"):
        solve_rig(read_sightings(files))


def inverse(lines: list[list[str]]) -> None:
    for row in lines:
        values = np.array([*map(float, row[1:])])
        pose = SE3(values[3:], values[:3]).inverse()
        row[1:] = [*map(str, [*pose.translation_m, *pose.rotation_wxyz])]


def reversed_rows(lines: list[list[str]]) -> None:
    poses = [row[1:] for row in lines][::-1]
    for row, pose in zip(lines, poses, strict=True):
        row[1:] = pose


def larger(lines: list[list[str]], times: float = 1.5) -> None:
    for row in lines:
        row[1:4] = [str(times * float(value)) for value in row[1:4]]


def pushed(lines: list[list[str]]) -> None:
    for row in lines[5:]:
        row[1] = str(float(row[1]) + 0.02)


@pytest.mark.parametrize(
    ("wreck", "message"),
    [
        (pushed, r"right, or a camera beside it, moved by 2[0-3] mm .* before .*5"),
        (inverse, "`invert` camera"),
        (reversed_rows, "one name"),
        (larger, "1.5 times as far"),
        (partial(larger, times=1.03), r"1\.0[34] times as far"),
    ],
)
def test_cameras_that_contradict_each_other_are_refused(
    tmp_path: Path, wreck: object, message: str
) -> None:
    files = tables(tmp_path, {"left": range(12), "right": range(12)})
    head, *rest = files[1].read_text().splitlines()
    lines = [line.split(",") for line in rest]
    assert callable(wreck)
    wreck(lines)
    files[1].write_text("\n".join([head, *map(",".join, lines)]))
    with pytest.raises(InputError, match=message):
        solve_rig(read_sightings(files))


def test_a_rig_of_few_moments_is_honest_or_refused(tmp_path: Path) -> None:
    rows = {"left": range(2), "right": range(2)}
    with pytest.raises(InputError, match="at 2 moments; record 3 or more"):
        solve_rig(read_sightings(tables(tmp_path, rows)))
    inside = 0
    for first in range(0, 24, 3):
        rows = {"left": range(first, first + 3), "right": range(first, first + 3)}
        rig = solve_rig(read_sightings(tables(tmp_path, rows)))
        pose = rig.relative[0].first_from_second
        inside += pose.squared_mahalanobis(CAMERAS["right"]) < 12.6
    assert inside >= 7
