#!/usr/bin/env bash
# Guess: cv2.calibrateCamera gives the same bits for the same corners, as most of OpenCV does: its
# optimization starts at the same point and draws nothing.
# Found with opencv-python-headless 5.0.0.93 on two cores: twelve calls with the same arrays in one
# process give up to twelve different answers, about 1e-8 pixels apart in the focal length. After
# cv2.setNumThreads(1) all are equal. Version 4.12.0.88 gives equal answers with any number of
# threads. So whoever compares bytes of a calibration, or caches by them, sets one thread first.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
cat > "$folder/calibrate.py" <<'PYTHON'
import cv2
import numpy as np

rng = np.random.default_rng(0)
board = np.zeros((54, 3), np.float32)
board[:, :2] = np.mgrid[0:9, 0:6].T.reshape(-1, 2) * 0.025
matrix = np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])
distortion = np.array([-0.2, 0.1, 0, 0, 0])
corners = []
for _ in range(15):
    turn = rng.normal(0, 0.3, 3)
    shift = np.array([-0.1, -0.06, 0.5]) + rng.normal(0, 0.03, 3)
    pixels = cv2.projectPoints(board, turn, shift, matrix, distortion)[0].reshape(-1, 2)
    corners.append((pixels + rng.normal(0, 0.1, pixels.shape)).astype(np.float32))


def answers(threads):
    cv2.setNumThreads(threads)
    boards = [board] * len(corners)
    calls = [cv2.calibrateCamera(boards, corners, (640, 480), None, None) for _ in range(12)]
    focal = [float(call[1][0, 0]) for call in calls]
    print(f"opencv {cv2.__version__}, {threads} threads: {len(set(focal))} different focal lengths,"
          f" {max(focal) - min(focal):.1e} px apart")
    return len(set(focal))


new = cv2.__version__.startswith("5.")
assert (answers(2) > 1) == new, "the number of threads matters otherwise than it did"
assert answers(1) == 1
PYTHON
for version in 4.12.0.88 5.0.0.93; do
    python3 -m venv "$folder/$version"
    "$folder/$version/bin/pip" install -q "opencv-python-headless==$version"
    "$folder/$version/bin/python" "$folder/calibrate.py"
done
