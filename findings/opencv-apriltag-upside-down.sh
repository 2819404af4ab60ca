#!/usr/bin/env bash
# Guess: a tag of the family 36h11 that OpenCV draws is the one that the AprilTag library draws, so
# both report the same corners and the same axes.
# Found with opencv-python-headless 4.12.0.88 and pupil-apriltags 1.0.4.post11: the numbers agree,
# but OpenCV's print is upside down for the AprilTag library. It lists the same four corners from
# the opposite one, and its pose of the tag is turned by 180 deg about the tag's normal. Its pixels
# have their centres at halves, so corners are half a pixel to the right and below.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "opencv-python-headless==4.12.0.88" \
    "pupil-apriltags==1.0.4.post11" "numpy==2.2.6"
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version

import cv2
import numpy as np
from pupil_apriltags import Detector

print("OpenCV", cv2.__version__, "pupil-apriltags", version("pupil-apriltags"))
dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
finder = cv2.aruco.ArucoDetector(dictionary)
reader = Detector(families="tag36h11")
matrix = np.array([[600.0, 0, 140], [0, 600, 140], [0, 0, 1]])
side = 0.05
half = side / 2
# OpenCV's corners: x right, y up, from the upper left one clockwise.
points = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
for number in (0, 7, 100, 586):
    tag = cv2.aruco.generateImageMarker(dictionary, number, 160)
    image = np.pad(tag, 60, constant_values=255)
    corners, ids, _ = finder.detectMarkers(image)
    assert ids.ravel().tolist() == [number]
    ours = corners[0].reshape(4, 2)
    (other,) = reader.detect(image, True, (600, 600, 140, 140), side)
    assert other.tag_id == number
    first = int(np.linalg.norm(other.corners - ours[0], axis=1).argmin())
    _, rotation, _ = cv2.solvePnP(points, ours, matrix, None, flags=cv2.SOLVEPNP_IPPE_SQUARE)
    flip = np.diag([1.0, -1, -1])
    difference = (cv2.Rodrigues(rotation)[0] @ flip).T @ other.pose_R
    angle = np.rad2deg(np.arccos((np.trace(difference) - 1) / 2))
    print(f"tag {number}: corners of OpenCV {ours.round().tolist()}")
    print(f"  of the AprilTag library {other.corners.round().tolist()}; poses differ by {angle:.0f} deg")
    # It lists from the lower left corner counter-clockwise: the upper left one is the last.
    assert first == 1, "an upright tag would have 3"
    assert abs(angle - 180) < 3
    in_plane = difference[2, 2]
    assert in_plane > 0.99
print("as described")
PYTHON
