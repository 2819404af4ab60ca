"""Camera files that a board contradicts: what is wrong with them, and none is wronged."""

import re
from dataclasses import replace

import numpy as np
import pytest

from evercal.calibration.boards.board import Board
from evercal.calibration.boards.board_poses import board_poses
from evercal.calibration.boards.corners import BoardView
from evercal.calibration.boards.stated_lens import compared_lens
from evercal.calibration.boards.tags import square
from evercal.calibration.pose_pairs.pairs import BoardCorners, PosePairs
from evercal.calibration.pose_pairs.solve import solve
from evercal.errors import InputError
from evercal.geometry import SE3, Camera

from .printed import CHESSBOARD, TAG, grid, view_of

PLAIN = Camera(640, 480, 620, 621, 322.3, 238.1)
BENT = replace(PLAIN, distortion=(-0.25, 0.1, 0.0, 0.0))
MODE = "its focal length is of another mode or stream"
SIZE = "it is of another resolution"
TWICE = "its distortion is applied twice"
POINTS = {"chessboard": grid(9, 6), "small": grid(9, 6) / 4, "apriltag": square(0.08)}


def views(
    camera: Camera, kind: str, count: int = 7, noise_px: float = 0.05, seed: int = 3
) -> dict[str, BoardView]:
    rng = np.random.default_rng(seed)
    board = TAG if kind == "apriltag" else CHESSBOARD
    seen = {}
    for i in range(count):
        pose = view_of(board, 1000 * seed + i)
        pixels = camera.project(pose.apply(POINTS[kind]))
        noise = rng.normal(0, noise_px, pixels.shape)
        seen[f"{i}.png"] = BoardView(POINTS[kind], pixels + noise)
    return seen


CASES: list[tuple[Camera, dict, str]] = [
    (PLAIN, {"fx": 385.0, "fy": 385.6}, f"{MODE}: fx 620.* fit, not fx 385 "),
    (PLAIN, {"fx": 690.0, "fy": 691.1}, f"{MODE}: fx 620.* fit, not fx 690 "),
    (PLAIN, {"fx": 930.0, "fy": 931.5}, MODE),
    (PLAIN, {"fx": 4.2, "fy": 4.207}, "its focal length is in millimetres"),
    (PLAIN, {"fx": 6.0, "fy": 6.01}, "its focal length is in millimetres"),
    (PLAIN, {"fx": 465.0}, "its fx is that of squeezed or cropped images"),
    (PLAIN, {"fx": 826.0}, "its fx is that of squeezed"),
    (PLAIN, {"fy": 828.0}, "its fy is that of squeezed"),
    (PLAIN, {"fy": 465.8}, "its fy is that of squeezed"),
    (
        PLAIN,
        {"fx": 310.0, "fy": 310.5, "cx": 161.15, "cy": 119.05},
        f"{SIZE}, 0.5 times this",
    ),
    (
        PLAIN,
        {"fx": 1240.0, "fy": 1242.0, "cx": 644.6, "cy": 476.2},
        f"{SIZE}, 2 times this",
    ),
    (PLAIN, {"fx": 930.0, "fy": 931.5, "cx": 483.4, "cy": 357.2}, SIZE),
    (PLAIN, {"cx": 238.1, "cy": 322.3}, "its x and y are swapped"),
    (PLAIN, {"cx": 400.0, "cy": 300.0}, "its principal point is of another crop"),
    (PLAIN, {"cx": 242.3}, "its principal point is of another crop"),
    (PLAIN, {"distortion": (-0.3, 0.09, 0, 0)}, TWICE),
    (PLAIN, {"distortion": (0.12, -0.2, 0, 0)}, TWICE),
    (PLAIN, {"distortion": (-0.08, 0, 0, 0)}, TWICE),
    (BENT, {"distortion": ()}, "it has no distortion, the lens does"),
    (BENT, {"distortion": (-0.5, 0.3, 0, 0)}, "its distortion is another"),
]


def check_contradiction(true: Camera, change: dict, words: str) -> None:
    stated = replace(true, **change)
    poses = board_poses(CHESSBOARD, stated, views(true, "chessboard"))
    widened, said = compared_lens(poses)
    assert said.startswith("the board contradicts the camera file: ")
    assert re.search(words, said)
    assert re.search(r"it moves pixels by up to [1-9]", said)
    free = board_poses(CHESSBOARD, true, views(true, "chessboard"))
    sigmas = []
    errors = []
    for own, right in zip(widened.detected, free.detected, strict=True):
        assert own.camera_from_board
        assert right.camera_from_board
        assert own.covariance is not None
        sigmas.append(np.sqrt(np.trace(own.covariance[:3, :3])))
        shift = own.camera_from_board.inverse() @ right.camera_from_board
        errors.append(np.linalg.norm(shift.translation_m))
    assert np.median(np.array(errors) / np.array(sigmas)) < 2.5


@pytest.mark.parametrize(("true", "change", "words"), CASES[::4])
def test_the_contradiction_is_named(true: Camera, change: dict, words: str) -> None:
    check_contradiction(true, change, words)


@pytest.mark.slow("src/evercal/calibration/boards")
@pytest.mark.parametrize(("true", "change", "words"), CASES)
def test_each_contradiction_is_named(true: Camera, change: dict, words: str) -> None:
    check_contradiction(true, change, words)


@pytest.mark.slow("src/evercal/calibration/boards")
@pytest.mark.parametrize("kind", [*POINTS])
@pytest.mark.parametrize(("count", "noise_px"), [(3, 0.1), (5, 0.05), (8, 0.3)])
@pytest.mark.parametrize("true", [PLAIN, BENT], ids=["plain", "bent"])
def test_exact_files_are_never_accused(
    kind: str, count: int, noise_px: float, true: Camera
) -> None:
    check_exact(kind, count, noise_px, true, 3)


@pytest.mark.parametrize(
    ("kind", "count", "noise_px", "true"),
    [
        ("chessboard", 5, 0.05, BENT),
        ("small", 3, 0.1, PLAIN),
        ("apriltag", 8, 0.3, BENT),
    ],
)
def test_exact_files_are_not_accused(
    kind: str, count: int, noise_px: float, true: Camera
) -> None:
    check_exact(kind, count, noise_px, true, 1)


def check_exact(
    kind: str, count: int, noise_px: float, true: Camera, seeds: int
) -> None:
    board = TAG if kind == "apriltag" else CHESSBOARD
    for seed in range(seeds):
        seen = views(true, kind, count, noise_px, seed)
        assert compared_lens(board_poses(board, true, seen))[1] == ""


def test_few_images_that_fit_badly_are_doubted() -> None:
    wrong = replace(PLAIN, fx=465.0)
    poses = board_poses(CHESSBOARD, wrong, views(PLAIN, "chessboard", 3))
    assert "corners fit the camera file only to" in compared_lens(poses)[1]


def test_solve_names_the_intrinsics_first() -> None:
    board = Board("chessboard", 0.03, 9, 6)
    seen = views(PLAIN, "chessboard", 10)
    wrong = replace(PLAIN, fx=385.0, fy=385.6)
    true = [view_of(CHESSBOARD, 3000 + i) for i in range(10)]
    mount = SE3.exp([0.05, -0.03, 0.04, 0.1, 0.2, 1.5])
    robot = SE3.stack([(mount @ pose).inverse() for pose in true])
    detected = board_poses(board, wrong, seen).detected
    poses = [image.camera_from_board for image in detected if image.camera_from_board]
    pairs = PosePairs(tuple(seen), robot, SE3.stack(poses))
    corners = BoardCorners(wrong, tuple(seen.values()), stated=True, board=board)
    with pytest.raises(InputError, match=f"^the board contradicts the camera.*{MODE}"):
        solve(pairs, "eye_in_hand", corners=corners)
