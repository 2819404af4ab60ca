"""Intrinsics from corners of a board."""

import cv2

from benchmarks.board_recordings import BoardSetting, record
from evercal.calibration.boards.intrinsics import calibrate_camera


def test_the_same_corners_give_the_same_bits() -> None:
    views = record(BoardSetting(), seed=0).views
    threads = cv2.getNumThreads()
    cv2.setNumThreads(2)
    try:
        cameras = {calibrate_camera(views, 640, 480).camera for _ in range(6)}
        assert len(cameras) == 1
        assert cv2.getNumThreads() == 2
    finally:
        cv2.setNumThreads(threads)
