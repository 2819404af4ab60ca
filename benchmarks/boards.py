"""Detection of rendered boards at known poses, beside the finders of OpenCV on the same images."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tqdm import tqdm

from benchmarks.board_images import (
    CAMERA,
    CHARUCO,
    CHESSBOARD,
    LARGE,
    TAG,
    Photo,
    corner_points,
    render,
)
from benchmarks.rows import save
from evercal.calibration.boards.board import Board, dictionary_of
from evercal.calibration.boards.corners import BoardView
from evercal.calibration.boards.detection import find_board
from evercal.geometry import Camera

WIDE = Camera(1280, 800, 1000.0, 1000.0, 639.5, 399.5, (-0.2, 0.06, 0.0, 0.0))
"""Camera of the large board."""
FIRST_SEED = 100
"""Seeds below were used while the detection was written."""
_BORDER_PX = 15


def detectors(board: Board) -> dict[str, Callable[[np.ndarray], np.ndarray | None]]:
    """Return finders by name, each from an image (H, W, 3) to corners (k, 2) or None."""

    def ours(image: np.ndarray) -> np.ndarray | None:
        view = find_board(image, board)
        return view.pixels if isinstance(view, BoardView) else None

    def grey(image: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(image[..., 0])

    def corners(found: Any) -> np.ndarray | None:
        return np.reshape(found[1], (-1, 2)) if found[0] else None

    size = (board.columns, board.rows)
    if board.kind == "chessboard":
        return {
            "evercal": ours,
            "classic": lambda i: corners(cv2.findChessboardCorners(grey(i), size)),
            "sectors": lambda i: corners(cv2.findChessboardCornersSB(grey(i), size)),
        }
    if board.kind == "charuco":
        printed = cv2.aruco.CharucoBoard(
            size, board.size_m, board.marker_m, dictionary_of(board)
        )
        detector = cv2.aruco.CharucoDetector(printed)

        def opencv(image: np.ndarray) -> np.ndarray | None:
            pixels, ids, _, _ = detector.detectBoard(grey(image))
            whole = len(corner_points(board))
            return (
                None if ids is None or len(ids) < whole else np.reshape(pixels, (-1, 2))
            )

        return {"evercal": ours, "opencv": opencv}
    tags = cv2.aruco.ArucoDetector(dictionary_of(board))

    def opencv_tag(image: np.ndarray) -> np.ndarray | None:
        found, _, _ = tags.detectMarkers(grey(image))
        return np.reshape(found[0], (4, 2)) if len(found) == 1 else None

    return {"evercal": ours, "opencv": opencv_tag}


def measure(board: Board, tilt_deg: float, count: int) -> list[dict[str, object]]:
    """Detect a board in rendered images that show it whole; one row for each finder."""
    camera = WIDE if board is LARGE else CAMERA
    finders = detectors(board)
    seed = FIRST_SEED
    images = 0
    found: dict[str, list[float]] = {name: [] for name in finders}
    seconds: dict[str, list[float]] = {name: [] for name in finders}
    any_of_opencv = 0
    while images < count:
        seed += 1
        photo = Photo(
            camera, tilt_deg, 1.25 + 0.3 * (seed % 3), roll_deg=25, aside=0.05
        )
        image, truth, _ = render(board, photo, seed)
        limit = np.array([camera.width, camera.height]) - 1 - _BORDER_PX
        inside = (truth.pixels > _BORDER_PX) & (truth.pixels < limit)
        if len(truth.pixels) < len(corner_points(board)) or not inside.all():
            continue
        images += 1
        detected = set()
        for name, find in finders.items():
            began = time.perf_counter()
            pixels = find(image)
            seconds[name].append(time.perf_counter() - began)
            if pixels is None or len(pixels) != len(truth.pixels):
                continue
            detected.add(name)
            order = pixels if name == "evercal" else _ordered(pixels, truth.pixels)
            found[name].append(float(((order - truth.pixels) ** 2).mean()))
        any_of_opencv += bool(detected - {"evercal"})
    return [
        {
            "board": f"{board.kind} {board.columns}x{board.rows}".removesuffix(" 0x0"),
            "tilt_deg": tilt_deg,
            "finder": name,
            "images": count,
            "found": len(found[name]),
            "any_of_opencv": any_of_opencv,
            "rms_px": float(np.sqrt(np.mean(found[name])))
            if found[name]
            else float("nan"),
            "ms": 1000 * float(np.median(seconds[name])),
        }
        for name in finders
    ]


def _ordered(pixels: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the corners in the order that fits the truth better: finders may begin at any end."""
    return min(pixels, pixels[::-1], key=lambda p: float(np.abs(p - truth).sum()))


def run(images: int = 30, out: Path = Path("runs/boards.csv")) -> None:
    """Detection of rendered boards at tilts of 0 to 60 degrees, beside OpenCV's finders.

    Args:
        images: Images of each board and tilt.
        out: File of the rows.
    """
    cv2.setNumThreads(1)
    cases = [
        (b, t)
        for b in (LARGE, CHESSBOARD, CHARUCO, TAG)
        for t in (0.0, 30.0, 45.0, 60.0)
    ]
    rows: list[dict[str, object]] = []
    for board, tilt in tqdm(cases, unit="case"):
        rows += measure(board, tilt, images)
    save(out, rows, {"images": images})
