"""Boards in simulated photographs: their corners, and boards other than the stated one."""

import re
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from evercal.calibration.boards.board import Board
from evercal.calibration.boards.corners import BoardView, Detection, board_pose
from evercal.calibration.boards.detection import find_board, find_boards
from evercal.calibration.boards.marker_layout import OtherSize
from evercal.calibration.boards.markers import (
    CharucoView,
    other_dictionary,
    sizes_pooled,
)
from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance

from .printed import (
    APRILGRID,
    ARUCOGRID,
    BOARDS,
    CAMERA,
    CHARUCO,
    CHESSBOARD,
    TAG,
    photographed,
    view_of,
)


def corners_in(image: np.ndarray, board: Board) -> BoardView:
    view = find_board(image, board)
    assert isinstance(view, BoardView), view
    return view


def detect(board: Board, pose: SE3, seed: int = 0) -> BoardView:
    return corners_in(photographed(board, pose, seed), board)


@pytest.mark.parametrize("board", BOARDS, ids=lambda b: b.kind)
def test_corners_and_poses_match_the_print(board: Board) -> None:
    errors = []
    for seed in range(3):
        pose = view_of(board, seed)
        view = detect(board, pose, seed)
        # The roll of the camera does not change the order of the corners.
        errors.append(view.pixels - CAMERA.project(pose.apply(view.points_m)))
        metres, radians = pose_distance(
            board_pose(view, CAMERA).camera_from_board, pose
        )
        assert metres < 0.0006
        assert np.rad2deg(radians) < 0.3
    error = np.concatenate(errors)
    assert np.abs(error.mean(0)).max() < 0.02  # a wrong pixel convention gives 0.5
    assert np.sqrt((error**2).mean()) < 0.1


def test_images_without_the_board_give_a_reason() -> None:
    grey = np.full((480, 640, 3), 128, np.uint8)
    tag = photographed(TAG, view_of(TAG, 1))
    chessboard = photographed(CHESSBOARD, view_of(CHESSBOARD, 0))
    part = (
        "inner corners, not 12x9 inner corners; show the whole board, or correct `size`"
    )
    for image, board, message in (
        (grey, CHESSBOARD, "no chessboard with 9x6 inner corners"),
        (grey, CHARUCO, "0 corners of the ChArUco board"),
        (grey, APRILGRID, "no markers of the grid, APRILTAG_36h11 from 0"),
        (grey, TAG, "no tag 3 of APRILTAG_36h11"),
        (tag, replace(TAG, tag=4), "it shows 3"),
        (chessboard, Board("chessboard", 0.03, 12, 9), part),
    ):
        reason = find_board(image, board)
        assert isinstance(reason, str)
        assert message in reason


@pytest.mark.parametrize(
    ("board", "message"),
    [
        (("chessboard", 0.03), "size of 3x3 to 200x200"),
        (("chessboard", 0.0, 9, 6), "allowed are 0.5 to 2000 mm"),
        (
            ("chessboard", 0.025e-3, 9, 6),
            "is 0.025 mm; allowed are 0.5 to 2000 mm",
        ),
        (
            ("chessboard", 25.0, 9, 6),
            "is 25000 mm; .*give millimetres: `square_mm`",
        ),
        (("chessboard", 0.025, 900, 6), "got 900x6"),
        (
            ("aprilgrid", 0.03, 6, 6),
            "is 0 mm; give `gap_mm`: .* Kalibr's tagSpacing",
        ),
        (
            ("charuco", 0.03, 5, 7, 0.04, "4X4_50"),
            "markers of a ChArUco board",
        ),
        (
            ("apriltag", 0.03, 0, 0, 0.0, "36h11"),
            "dictionary '36h11' is not known",
        ),
    ],
)
def test_invalid_boards_are_refused(board: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Board(*board)


def test_only_chessboards_of_even_sum_look_the_same_after_half_a_turn() -> None:
    assert not CHESSBOARD.half_turn
    assert Board("chessboard", 0.03, 8, 6).half_turn
    assert Board("chessboard", 0.03, 9, 7).half_turn
    assert not CHARUCO.half_turn
    assert Board("chessboard", 0.03, 7, 7).quarter_turn
    assert not Board("chessboard", 0.03, 9, 7).quarter_turn


def test_charuco_boards_of_older_opencv_are_detected() -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    # Patterns differ for even rows.
    board = Board("charuco", 0.04, 5, 6, 0.03, "4X4_50")
    page = cv2.aruco.CharucoBoard((5, 6), 0.04, 0.03, dictionary)
    page.setLegacyPattern(True)
    image = page.generateImage((600, 720), marginSize=40)
    view = corners_in(np.repeat(image[..., None], 3, 2).astype(np.uint8), board)
    assert len(view.points_m) == 20


# Two by two tags from 36h11, number 0 at the lower left and 3 at the upper right, a bit of a tag is
# two pixels, as kalibr_create_target_pdf draws them: rows go up, and the border has two bits. Bits
# are those of moms-apriltag 2023.1.15, which draws tags as the AprilTag project does.
KALIBR_BITS = {
    0: (0b110101, 0b011101, 0b011000, 0b101000, 0b010110, 0b000100),
    1: (0b110110, 0b010111, 0b111100, 0b011000, 0b101101, 0b001001),
    2: (0b110111, 0b010010, 0b100000, 0b001001, 0b000100, 0b001110),
    3: (0b111001, 0b000111, 0b100111, 0b101001, 0b110010, 0b011000),
}


def kalibr_print(pixels_a_bit: int = 12) -> np.ndarray:
    """Return a print of 2x2 tags of 10 bits with gaps of 3 bits, and 5 bits of white around."""
    sheet = np.ones((36, 36), np.uint8)
    for tag, rows in KALIBR_BITS.items():
        x = 8 + 13 * (tag % 2)
        y = 8 + 13 * (1 - tag // 2)
        sheet[y : y + 10, x : x + 10] = 0
        bits = [[row >> (5 - k) & 1 for k in range(6)] for row in rows]
        sheet[y + 2 : y + 8, x + 2 : x + 8] = bits
        for corner_y in (y - 3, y + 10):
            for corner_x in (x - 3, x + 10):
                sheet[corner_y : corner_y + 3, corner_x : corner_x + 3] = 0
    return 255 * sheet.repeat(pixels_a_bit, 0).repeat(pixels_a_bit, 1)


def test_a_grid_of_kalibr_has_the_frame_of_kalibr() -> None:
    image = cv2.GaussianBlur(kalibr_print(), (0, 0), 1.0).astype(np.uint8)
    board = Board("aprilgrid", 0.1, 2, 2, dictionary="APRILTAG_36h11", gap_m=0.03)
    view = corners_in(np.repeat(image[..., None], 3, 2), board)
    assert len(view.pixels) == 16
    # The origin is the lower left corner of tag 0, y goes up.
    origin = np.array([8 * 12 - 0.5, (8 + 13 + 10) * 12 - 0.5])
    expected = origin + view.points_m[:, :2] * (1200, -1200)
    assert np.abs(view.pixels - expected).max() < 0.05


def test_squares_of_kalibr_do_not_move_the_corners_of_a_tag() -> None:
    tag = Board("apriltag", APRILGRID.size_m, dictionary="APRILTAG_36h11", tag=5)
    grid = []
    alone = []
    for seed in range(4):
        pose = view_of(APRILGRID, seed)
        whole = detect(APRILGRID, pose, seed)
        error = whole.pixels - CAMERA.project(pose.apply(whole.points_m))
        assert len(whole.pixels) == 48
        grid.append((error**2).mean())
        view = corners_in(photographed(APRILGRID, pose, seed), tag)
        near = np.linalg.norm(whole.pixels[:, None] - view.pixels, axis=2).min(0)
        alone.append(np.square(near).mean())
    assert np.sqrt(np.mean(grid)) < 0.05
    assert np.sqrt(np.mean(alone)) < 0.05


@pytest.mark.parametrize("board", [APRILGRID, ARUCOGRID], ids=lambda b: b.kind)
def test_the_first_marker_of_a_grid_may_have_any_number(board: Board) -> None:
    printed = replace(board, tag=9)
    images = {
        str(seed): photographed(printed, view_of(board, seed)) for seed in range(2)
    }
    found, views, _ = find_boards(
        list(images), images.__getitem__, replace(board, tag=None)
    )
    assert found.tag == 9
    assert [
        len(view.pixels) for view in views.values() if isinstance(view, BoardView)
    ] == [48, 48]
    half = {"": images["0"].copy()}
    half[""][:, :320] = 128  # only some of the markers
    view = find_boards([""], half.__getitem__, printed)[1][""]
    assert isinstance(view, BoardView)
    pose = view_of(board, 0)
    assert np.abs(view.pixels - CAMERA.project(pose.apply(view.points_m))).max() < 0.2


@pytest.mark.parametrize(
    ("printed", "stated", "message"),
    [
        (
            CHARUCO,
            {"columns": 5, "rows": 6},
            "markers 0 to 14 are visible, they fit 6x5 squares",
        ),
        (
            CHARUCO,
            {"columns": 4, "rows": 4},
            "they fit 6x5 squares, not 4x4; correct `size`",
        ),
        (
            CHARUCO,
            {"marker_m": 0.02},
            "markers measure 30.* mm beside squares of 40 mm, not 20",
        ),
        (
            APRILGRID,
            {"columns": 3, "rows": 4},
            "they fit 4x3 markers from `tag` 0, not 3x4",
        ),
        (
            ARUCOGRID,
            {"columns": 4, "rows": 2},
            "they fit 4x3 markers from `tag` 0, not 4x2",
        ),
        (
            ARUCOGRID,
            {"tag": 5},
            "they fit 4x3 .* from `tag` 0, not 4x3; correct `size` or `tag`",
        ),
        (
            APRILGRID,
            {"gap_m": 0.01},
            "gaps measure 12.* mm beside markers of 40 mm, not 10",
        ),
        (CHESSBOARD, {"columns": 8}, "(9x6|6x9) inner corners, not 8x6 inner corners"),
    ],
)
def test_a_board_of_another_size_is_named_after_a_few_images(
    printed: Board, stated: dict[str, float], message: str
) -> None:
    images = [
        photographed(printed, view_of(printed, seed), seed) for seed in (0, 1, 3, 4)
    ]
    reads: list[str] = []

    def read(name: str) -> np.ndarray:
        reads.append(name)
        return images[len(reads) - 1]

    wrong = replace(printed, **stated)
    with pytest.raises(
        InputError, match="no board in any of 4 images, spread over 40 "
    ) as raised:
        find_boards([str(i) for i in range(40)], read, wrong)
    assert re.search(message, str(raised.value))
    assert len(reads) == 4


def test_a_chessboard_at_the_border_is_a_part_of_a_board() -> None:
    image = photographed(CHESSBOARD, view_of(CHESSBOARD, 0))
    cut = find_board(np.ascontiguousarray(image[:, 260:]), CHESSBOARD)
    assert isinstance(cut, str)
    assert (
        "cut by the border of the image, not 9x6 inner corners; show the whole board"
        in cut
    )


def test_a_search_ends_after_twenty_images_without_a_board() -> None:
    grey = np.full((120, 160, 3), 128, np.uint8)
    shown = photographed(TAG, view_of(TAG, 1))
    with pytest.raises(
        InputError, match="no board in any of 20 images, spread over 300 "
    ):
        find_boards([str(i) for i in range(300)], lambda _: grey, TAG)
    images = [grey] * 9 + [shown]
    views = find_boards(
        [str(i) for i in range(10)], lambda name: images[int(name)], TAG
    )[1]
    assert [isinstance(view, BoardView) for view in views.values()] == [False] * 9 + [
        True
    ]


def test_every_window_of_refinement_stays_between_edges() -> None:
    # A strongly tilted board: rows are 3 times closer than columns.
    rotation = Rotation.from_euler("x", 65, degrees=True).as_quat(scalar_first=True)
    pose = SE3(rotation, np.array([-0.12, -0.03, 0.5]))
    view = detect(CHESSBOARD, pose)
    error = view.pixels - CAMERA.project(pose.apply(view.points_m))
    assert np.sqrt((error**2).mean()) < 0.06


def test_an_image_that_cannot_be_read_keeps_its_reason_beside_a_grid() -> None:
    shown = photographed(APRILGRID, view_of(APRILGRID, 0))
    images = {"good": shown, "bad": "not an image"}
    _, views, _ = find_boards(list(images), images.__getitem__, APRILGRID)
    assert views["bad"] == "not an image"
    assert isinstance(views["good"], BoardView)


@pytest.mark.parametrize(("doubted", "refused"), [(5, False), (9, True)])
def test_the_size_of_markers_is_judged_by_most_images(
    doubted: int, refused: bool
) -> None:
    points = np.eye(4, 3)
    views: dict[str, Detection] = {}
    for i in range(16):
        other = OtherSize("markers measure 17 mm") if i < doubted else ""
        views[str(i)] = CharucoView(points, points[:, :2], other)
    views["dark"] = "no corners"
    pooled = sizes_pooled(views)
    reasons = [name for name, view in pooled.items() if isinstance(view, OtherSize)]
    assert len(reasons) == (doubted if refused else 0)
    assert pooled["dark"] == "no corners"
    assert isinstance(pooled["15"], BoardView)


def test_another_dictionary_that_fits_is_named() -> None:
    images = {str(i): photographed(TAG, view_of(TAG, i)) for i in range(4)}
    other = replace(TAG, dictionary="5X5_50")
    with pytest.raises(InputError, match=f"give `dictionary` {TAG.dictionary}"):
        find_boards(list(images), images.__getitem__, other)
    assert other_dictionary(list(images.values()), TAG) == ""


@pytest.mark.parametrize("board", [CHARUCO, TAG, APRILGRID, ARUCOGRID])
def test_mirrored_images_of_markers_are_named(board: Board) -> None:
    images = {}
    for i in range(4):
        image = photographed(board, view_of(board, i))
        images[str(i)] = np.ascontiguousarray(image[:, ::-1])
    with pytest.raises(InputError, match="switch the mirror of the camera off"):
        find_boards(list(images), images.__getitem__, board)
