"""Is a calibration as good as it states? Points that the tool touched, picked in images.

    python examples/07_verify.py

The tripod camera of the packaged cell is calibrated by the map. Four points are touched by the tool
and picked in one image: here they are projected by the true pose, with half a pixel of noise.
"""

import json
from dataclasses import replace

import numpy as np

import evercal
from evercal.calibration.picked_points import PickedPoint
from evercal.calibration.unseen.touched import touched_data, touched_tips
from evercal.geometry import SE3
from evercal.recordings.samples import CELL

cell = evercal.Map.open("cell.evercal")
if not cell.scenes:
    cell.learn(CELL / "wrist")
tripod = cell.calibrate(CELL / "tripod")

rng = np.random.default_rng(0)
truth = json.loads((CELL / "truth.json").read_text("utf-8"))["base_from_camera"]
true = SE3(truth["quaternion_wxyz"], truth["translation_m"])
corners = {"a": (0.4, 0, 0), "b": (0.6, 0, 0), "c": (0.6, 0.2, 0), "d": (0.4, 0.2, 0.1)}
points = {name: np.array(point) for name, point in corners.items()}
picks = []
for name, point in points.items():
    pixel = tripod.camera.project(true.inverse().apply(point))
    picks.append(PickedPoint("0000.jpg", name, pixel + rng.normal(0, 0.5, 2)))

pushed = replace(tripod, parent_from_child=true @ SE3.from_translation([0.02, 0, 0]))
for calibration in (tripod, pushed):
    data = touched_data(calibration, touched_tips(points), picks, {})
    print(calibration.verify(data).sentence)
