#!/usr/bin/env bash
# mujoco 4.0.0: a camera's principalpixel is the way from the principal point to the middle of the
# image, so "12 7" moves a point on the axis by 12 pixels to the left and 7 up. The images that are
# drawn follow it (their frustum does). The sensor camprojection ignores it: it puts that point in
# the middle of the image, so its pixels are off by the principal point.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mujoco==4.0.0
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version

import mujoco
import numpy as np

print("mujoco", version("mujoco"))
model = mujoco.MjModel.from_xml_string("""
<mujoco>
  <worldbody>
    <site name="ahead" pos="1 0 0"/>
    <camera name="camera" xyaxes="0 -1 0 0 0 1" resolution="640 480" sensorsize="0.0064 0.0048"
            focalpixel="525 525" principalpixel="12 7"/>
  </worldbody>
  <sensor><camprojection site="ahead" camera="camera"/></sensor>
</mujoco>
""")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
scene = mujoco.MjvScene(model, 10)
camera = mujoco.MjvCamera()
camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
camera.fixedcamid = 0
options = mujoco.MjvOption()
mujoco.mjv_updateScene(
    model, data, options, None, camera, mujoco.mjtCatBit.mjCAT_ALL, scene
)
drawn = scene.camera[0]
right = drawn.frustum_width - drawn.frustum_center
u = right / (2 * drawn.frustum_width) * 640
v = drawn.frustum_top / (drawn.frustum_top - drawn.frustum_bottom) * 480
print(f"a point on the axis, pixels from the corner: drawn at {u:.2f} {v:.2f}")
print(f"sensor camprojection: {data.sensordata}")
assert np.allclose([u, v], [308, 233], atol=1e-3), "the frustum has changed"
assert np.allclose(data.sensordata, [320, 240]), "camprojection has changed"
PYTHON
