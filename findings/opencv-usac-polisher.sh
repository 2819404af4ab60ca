#!/usr/bin/env bash
# Guess: with `UsacParams.final_polisher = NONE_POLISHER` and `loMethod = LOCAL_OPTIM_NULL`, OpenCV
# returns the best model of a minimal sample, which fits three points (a pose) or four (a homography)
# exactly, and takes the time of its samples alone.
# Found with opencv-python-headless 5.0.0.93: the field has no effect on solvePnPRansac and
# findHomography. Each polisher returns the same model to the last bit, and it fits no point exactly:
# least squares always follow. For poses they solve for the eigenvalues of a 27x27 matrix, so a call
# of a single iteration takes as long as about a hundred more.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "opencv-python-headless==5.0.0.93" "numpy==2.4.6"
"$folder/venv/bin/python" - <<'PYTHON'
import cv2
import numpy as np

print("OpenCV", cv2.__version__)
cv2.setNumThreads(1)
random = np.random.default_rng(0)
focal = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
points = random.uniform([-1, -1, 3], [1, 1, 6], (100, 3))
pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), focal, None)[0][:, 0]
pixels += random.normal(0, 1, pixels.shape)
pixels[:40] = random.uniform(0, [640, 480], (40, 2))
homography = np.array([[1.1, 0.1, 3], [0.05, 0.9, -4], [0.01, 0.02, 1]])
source = random.uniform(0, 10, (100, 2))
target = cv2.perspectiveTransform(source[None], homography)[0]
target += random.normal(0, 0.02, target.shape)
target[:40] = random.uniform(-10, 20, (40, 2))

poses, planes = [], []
for name in ("NONE_POLISHER", "LSQ_POLISHER", "COV_POLISHER"):
    parameters = cv2.UsacParams()
    parameters.loMethod = cv2.LOCAL_OPTIM_NULL
    parameters.final_polisher = getattr(cv2, name)
    parameters.threshold = 4.0
    solved, _, turn, shift, _ = cv2.solvePnPRansac(points, pixels, focal, None, params=parameters)
    seen = cv2.projectPoints(points, turn, shift, focal, None)[0][:, 0]
    errors = np.sort(np.linalg.norm(seen - pixels, axis=1))
    poses.append([*turn.ravel(), *shift.ravel()])
    parameters.threshold = 0.1
    plane, _ = cv2.findHomography(source, target, parameters)
    seen = cv2.perspectiveTransform(source[None], plane)[0]
    plane_errors = np.sort(np.linalg.norm(seen - target, axis=1))
    planes.append(plane.ravel())
    print(f"{name}: smallest errors of the pose {errors[:3].round(3)} px")
    print(f"{name}: smallest errors of the homography {plane_errors[:4].round(4)}")
    assert solved and errors[0] > 0.01 and plane_errors[0] > 0.001
assert all(pose == poses[0] for pose in poses)
assert all((plane == planes[0]).all() for plane in planes)
print("as described")
PYTHON
