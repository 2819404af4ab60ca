"""Camera files of other programs, fisheyes and models among them."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evercal.recordings.cameras.camera_file import read_camera
from evercal.recordings.cameras.radial_models import image_radius

from ..checks import refused
from .test_camera_file import CAMERA, FLAT, MESSAGE, SIZE, D, written

KALIBR = """\
cam0:
  camera_model: pinhole
  intrinsics: [525.25, 526.5, 319.5, 239.25]
  distortion_model: radtan
  distortion_coeffs: [0.1, -0.02, 0.001, 1e-05]
  T_cam_imu:
  - [0.0148, -0.9998, 0.0041, -0.0216]
  - [0.9995, 0.0149, 0.0257, -0.0646]
  - [-0.0257, 0.0037, 0.9996, 0.0098]
  - [0.0, 0.0, 0.0, 1.0]
  timeshift_cam_imu: -8.121e-05
  cam_overlaps: [1]
  rostopic: /cam0/image_raw
  resolution: [640, 480]
"""
EUROC = """\
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)
T_BS:
  cols: 4
  rows: 4
  data: [0, -1, 0, -0.02, 1, 0, 0, -0.06, 0, 0, 1, 0.01, 0, 0, 0, 1]
rate_hz: 20
resolution: [640, 480]
camera_model: pinhole
intrinsics: [525.25, 526.5, 319.5, 239.25] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [0.1, -0.02, 0.001, 1e-05]
"""
ORB_SLAM = """\
%YAML:1.0

File.version: "1.0"
Camera.type: "PinHole"
Camera1.fx: 525.25
Camera1.fy: 526.5
Camera1.cx: 319.5
Camera1.cy: 239.25
Camera1.k1: 0.1
Camera1.k2: -0.02
Camera1.p1: 0.001
Camera1.p2: 1e-05
Camera.width: 640
Camera.height: 480
Camera.newWidth: 320
Camera.fps: 30.0
Camera.RGB: 1
Camera.bf: 47.9
ORBextractor.nFeatures: 1200
ORBextractor.scaleFactor: 1.2
IMU.T_b_c1: !!opencv-matrix
   rows: 4
   cols: 4
   dt: f
   data: [1, 0, 0, 0.1, 0, 1, 0, 0.2, 0, 0, 1, 0.3, 0, 0, 0, 1]
Viewer.ViewpointF: 500.0
"""
VINS = """\
%YAML:1.0
---
model_type: PINHOLE
camera_name: camera
image_width: 640
image_height: 480
distortion_parameters:
   k1: 0.1
   k2: -0.02
   p1: 0.001
   p2: 1e-05
projection_parameters:
   fx: 525.25
   fy: 526.5
   cx: 319.5
   cy: 239.25
"""
ZIVID = """\
__version__: {serializer: 1, data: 12}
CameraMatrix: {CX: 319.5, CY: 239.25, FX: 525.25, FY: 526.5}
Distortion: {K1: 0.1, K2: -0.02, K3: 0, P1: 0.001, P2: 0.00001}
"""
RADTAN = replace(CAMERA, distortion=CAMERA.distortion[:4])


@pytest.mark.parametrize(
    "text", [KALIBR, EUROC, ORB_SLAM, ORB_SLAM.replace("a1.", "a."), VINS]
)
def test_camera_files_of_other_programs_are_read(tmp_path: Path, text: str) -> None:
    camera = read_camera(written(tmp_path, text))
    assert camera.coefficients == RADTAN.coefficients
    assert replace(camera, distortion=RADTAN.distortion) == RADTAN


FISHEYE = replace(CAMERA, distortion=(0.1, -0.02, 0.001, 1e-5), model="fisheye")


@pytest.mark.parametrize(
    "text",
    [
        KALIBR.replace("radtan", "equidistant"),
        ORB_SLAM.replace("PinHole", "KannalaBrandt8")
        .replace("p1", "k3")
        .replace("p2", "k4"),
        json.dumps(FISHEYE.to_dict()),
        MESSAGE.replace("rational_polynomial", "equidistant").replace(
            "- 0.03\n- 0.0\n", "- 0.0\n"
        ),
        json.dumps({"K": FLAT, "D": D[:4], **SIZE, "camera_model": "OPENCV_FISHEYE"}),
        json.dumps({"K": FLAT, "D": [*D[:4], 0], **SIZE, "model": "fisheye"}),
    ],
)
def test_fisheyes_have_k1_to_k4(tmp_path: Path, text: str) -> None:
    assert read_camera(written(tmp_path, text.replace("- 0.0\n", ""))) == FISHEYE


def test_a_fisheye_states_its_distortion(tmp_path: Path) -> None:
    for fields, message in (
        ({}, "'distortion_coefficients' is missing"),
        ({"D": None, "k5": 1.0}, "got k5"),
        ({"D": D}, "0 or 4 finite coefficients"),
        ({"k1": 0.1, "p1": 0.01}, "a fisheye has k1, k2, k3, k4, got p1"),
    ):
        text = json.dumps({"K": FLAT, **SIZE, "model": "fisheye", **fields})
        refused(message, read_camera, written(tmp_path, text))


@pytest.mark.parametrize("kind", ["omni", "eucm", "ds"])
def test_models_of_kalibr_become_the_nearest_fisheye(tmp_path: Path, kind: str) -> None:
    own = {"omni": [1.2], "eucm": [0.6, 1.1], "ds": [-0.2, 0.6]}[kind]
    focal = 300.0
    text = f"""
cam0:
  camera_model: {kind}
  intrinsics: {[*own, focal, focal, 320.0, 240.0]}
  distortion_model: none
  distortion_coeffs: []
  resolution: [640, 480]
"""
    camera = read_camera(written(tmp_path, text))
    assert camera.model == "fisheye"
    angles = np.deg2rad(np.linspace(1, 60, 30))
    points = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], -1)
    radii = focal * image_radius(kind, angles, own)
    np.testing.assert_allclose(camera.project(points)[:, 0] - 320.0, radii, atol=0.01)
    bent = text.replace("coeffs: []", "coeffs: [0.1, 0.0, 0.0, 0.0]")
    refused("no other distortion", read_camera, written(tmp_path, bent))


def test_the_model_fov_has_one_coefficient(tmp_path: Path) -> None:
    fields = {
        "K": [300.0, 300.0, 320.0, 240.0],
        "distortion_model": "fov",
        "D": [0.9],
        **SIZE,
    }
    camera = read_camera(written(tmp_path, json.dumps(fields)))
    x = camera.project([np.tan(0.8), 0.0, 1.0])[0]
    assert x == pytest.approx(
        320 + 300 * np.arctan(2 * np.tan(0.8) * np.tan(0.45)) / 0.9, abs=0.01
    )


def test_zivid_has_no_size(tmp_path: Path) -> None:
    camera = read_camera(written(tmp_path, ZIVID), (640, 480))
    assert camera == replace(CAMERA, distortion=(*CAMERA.distortion[:4], 0.0))
    refused("no image size", read_camera, written(tmp_path, ZIVID))


def test_of_several_cameras_the_one_of_the_images_is_read(tmp_path: Path) -> None:
    second = KALIBR.replace("cam0", "cam1").replace("525.25", "500")
    file = written(tmp_path, KALIBR + second)
    refused(
        r"holds 2 cameras: cam0 \(640x480, fx 525\.2\), cam1 \(.*", read_camera, file
    )
    refused("such as FILE:cam0", read_camera, file, (640, 480))
    assert read_camera(f"{file}:cam0") == RADTAN
    written(tmp_path, KALIBR + second.replace("[640, 480]", "[1280, 960]"))
    assert read_camera(file, (640, 480)) == RADTAN
    assert (
        read_camera(written(tmp_path, KALIBR + KALIBR.replace("cam0", "cam1")))
        == RADTAN
    )
    written(tmp_path, KALIBR + second.replace("radtan", "fov"))
    refused("cam1: a camera of model fov has omega", read_camera, file)
    stereo = (
        ORB_SLAM.replace("a1.", "a.") + "LEFT.K: [600, 0, 320, 0, 600, 240, 0, 0, 1]\n"
    )
    refused(
        r"holds 2 cameras: Camera \(640x480, fx 525.2\), LEFT \(640x480, fx 600.0\)",
        read_camera,
        written(tmp_path, stereo + "LEFT.D: [0]\nLEFT.width: 640\nLEFT.height: 480\n"),
    )
