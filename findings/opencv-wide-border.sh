#!/usr/bin/env bash
# Guess: OpenCV reads a marker only if its black border is as wide as `markerBorderBits` states (by
# default one cell); Kalibr's AprilGrid, whose tags have a border of two cells, is not read then.
# Found with opencv-python-headless 5.0.0.93: small tags with two cells are indeed not read. Large
# ones are, with the right number and without a sign that something is wrong, but corners lie up to
# one cell inside of the tag. The threshold is local, so a wide dark border becomes a ring, and the
# inside of the ring is taken for the tag. Its side is then about 0.9 of the true one.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "opencv-python-headless==5.0.0.93" "numpy==2.4.6"
"$folder/venv/bin/python" - <<'PYTHON'
import cv2
import numpy as np

dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
print("OpenCV", cv2.__version__)
read = {}
for cell in (4, 6, 12):
    tag = cv2.aruco.generateImageMarker(dictionary, 5, 10 * cell, borderBits=2)
    image = cv2.GaussianBlur(np.pad(tag, 40, constant_values=255), (0, 0), 1.0)
    for border in (1, 2):
        parameters = cv2.aruco.DetectorParameters()
        assert parameters.markerBorderBits == 1
        parameters.markerBorderBits = border
        corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
        side = None if ids is None else float(np.ptp(corners[0][0, :, 0])) / (10 * cell)
        read[cell, border] = None if ids is None else (int(ids.ravel()[0]), round(side, 2))
        print(f"{cell} px a cell, markerBorderBits {border}: number and side {read[cell, border]}")
assert read[4, 1] is None and read[4, 2][0] == 5
assert read[12, 1][0] == 5 and 0.75 < read[12, 1][1] < 0.95
assert read[12, 2][0] == 5 and abs(read[12, 2][1] - 1.0) < 0.05
print("as described")
PYTHON
