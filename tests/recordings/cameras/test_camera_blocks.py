"""Distortion that stands in another block than the focal length, and files of several cameras."""

import json
from pathlib import Path

import numpy as np
import pytest

from evercal.geometry import Camera
from evercal.recordings.cameras.camera_file import read_camera

from ..checks import refused
from .test_camera_file import written

SIZE = (640, 480)
PLAIN = {"fx": 525.0, "fy": 525.0, "cx": 319.5, "cy": 239.5}
MATRIX = [[525.0, 0, 319.5], [0, 525.0, 239.5], [0, 0, 1]]
D = [0.1, -0.05, 0.001, -0.002, 0.01]
DIST = dict(zip(("k1", "k2", "p1", "p2", "k3"), D, strict=True))
WIDE = {"fx": 600.0, "fy": 600.0, "cx": 639.5, "cy": 359.5}
WIDE_SIZE = {"width": 1280, "height": 720}
CAMERA = Camera.from_matrix(MATRIX, *SIZE, tuple(D))
RIGHT = [[520.0, 0, 319.5], [0, 520.0, 239.5], [0, 0, 1]]

READ = {
    "orbbec": {
        "rgbIntrinsic": {**PLAIN, "width": 640, "height": 480},
        "rgbDistortion": {**DIST, "k4": 0, "k5": 0, "k6": 0},
    },
    "orbbec, both": {
        "depthIntrinsic": {**WIDE, **WIDE_SIZE},
        "rgbIntrinsic": {**PLAIN, "width": 640, "height": 480},
        "depthDistortion": {"k1": 5.0},
        "rgbDistortion": DIST,
        "transform": {"rot": [1, 0, 0, 0, 1, 0, 0, 0, 1], "trans": [25.0, 0, 0]},
        "isMirrored": False,
    },
    "texture camera": {
        "textureCameraIntrinsics": {"cameraMatrix": PLAIN, "cameraDistortion": DIST}
    },
    "words between": {"color_intrinsics": PLAIN, "colour_distortion_coeffs": D},
    "list beside": {"rgb": PLAIN, "color_dist": D},
    "other name": {"K": MATRIX, "optics": DIST},
    "within": {"camera": {**PLAIN, "lens": DIST}},
    "two levels": {"device": {"intrinsics": PLAIN}, "lens": {"distortion": D}},
    "model beside": {"sensor": {"K": MATRIX}, "lens": {"model": "brown", "coeffs": D}},
    "depth beside": {
        "depth": {"intrinsics": {**WIDE, **WIDE_SIZE}, "coeffs": [9.0, 0, 0, 0, 0]},
        "color": {"intrinsics": PLAIN, "coeffs": D, "width": 640, "height": 480},
    },
    "pairs of a map": {
        "cameraData": [
            [0, {"intrinsicMatrix": RIGHT, **WIDE_SIZE, "distortionCoeff": [1.0] * 4}],
            [2, {"intrinsicMatrix": MATRIX, "distortionCoeff": [*D] + 9 * [0]}],
        ]
    },
    "lists of cameras and sizes": {
        "value0": {
            "intrinsics": [{"camera_type": "pinhole", "intrinsics": PLAIN}],
            "resolution": [[640, 480]],
            "distortions": [D],
        }
    },
    "same twice": {"a": {"K": MATRIX, "D": D}, "b": {"K": MATRIX, "D": D}},
    "neutral words": {"cam_mtx": MATRIX, "lensDistortion": D, "R": np.eye(3).tolist()},
}


@pytest.mark.parametrize("name", READ)
def test_distortion_of_a_neighbour_is_read(tmp_path: Path, name: str) -> None:
    camera = read_camera(written(tmp_path, json.dumps(READ[name])), SIZE)
    assert camera.coefficients == CAMERA.coefficients
    assert (camera.size, camera.matrix().tolist()) == (SIZE, CAMERA.matrix().tolist())


REFUSED = {
    "no name of OpenCV": ({"K": MATRIX, "optics": {"a": 0.1}}, "'optics.a' is not"),
    "polynomial": ({**PLAIN, "undistort": {"poly": D}}, "'undistort.poly' is not"),
    "nine numbers": ({**PLAIN, "lensPoly": [0.1] * 9}, "'lensPoly' is not known"),
    "radial": (
        {"rgb": PLAIN, "rgb_lens": {"radial": D[:2]}},
        "'rgb_lens.radial' is not known",
    ),
    "of the other camera": (
        {"color": PLAIN, "depthDistortion": DIST},
        "'depthDistortion.k1' is not known",
    ),
    "of one of two": (
        {"rgb": PLAIN, "ir": {**WIDE, **WIDE_SIZE}, "lens": DIST},
        "'lens.k1' is not known",
    ),
    "twice": (
        {"rgb": {**PLAIN, "coeffs": [0.0] * 5}, "rgbDistortion": DIST},
        "'rgbDistortion.k1' is not known",
    ),
    "deep": (
        {"camera": {"K": MATRIX, "lens": {"group": {"warp": [0.1, 0.2]}}}},
        "lens.group.warp' is not known",
    ),
    "cut out": (
        {"K": MATRIX, "roi": {"x_offset": 8, "y_offset": 0}},
        "the image is a cut-out",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_lens_of_unknown_meaning_is_refused_by_name(
    tmp_path: Path, name: str
) -> None:
    data, message = REFUSED[name]
    refused(message, read_camera, written(tmp_path, json.dumps(data)), SIZE)


RIGHT_INPUT = (
    {"extrinsics": {"rotation": np.eye(3).tolist(), "translation": {"x": 0.1}}},
    {"imu": {"noise_density": 0.01, "T_cam_imu": np.eye(4).tolist()}},
    {"board": {"squares_x": 8, "square_mm": 25.0}, "reprojection_error": 0.2},
    {"header": {"stamp": {"sec": 12, "nanosec": 5}, "frame_id": "camera"}, "D": [0.0]},
    {"roi": {"x_offset": 0, "y_offset": 0, "width": 640, "height": 480}, "D": [0] * 5},
    {"lens": {"k1": 0.0, "k2": 0.0}, "lensPosition": 130, "serial": "0123"},
    {"stereo": {"baseline": 0.12, "R": np.eye(3).tolist()}, "depth_scale": 0.001},
    {
        "base_from_camera": {"xyz": [0.1, 0, 1], "rpy": [0, 1, 0]},
        "T_cam_imu": [0.1] * 7,
    },
    {"robot": {"dof": 6, "home": [0.1] * 6}, "gripper": {"width_m": 0.08}, "seed": 3},
    {"optimal_camera_matrix": np.eye(3).tolist(), "ret": 0.3, "rvecs": [[1, 2, 3]]},
    {"fov": 60, "focal": 3.6, "sensor_width": 5},
    {"P1": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], "new_camera_matrix": MATRIX},
)


@pytest.mark.parametrize("more", RIGHT_INPUT)
def test_other_blocks_are_no_lens(tmp_path: Path, more: dict[str, object]) -> None:
    text = json.dumps({"K": MATRIX, **more})
    assert read_camera(written(tmp_path, text), SIZE) == CAMERA.pinhole


SEVERAL = {
    "stereo": {"M1": MATRIX, "D1": D, "M2": RIGHT, "D2": [0.0] * 5, "T": [0.1, 0, 0]},
    "left and right": {"mtx_l": MATRIX, "dist_l": D, "mtx_r": RIGHT, "dist_r": [0] * 5},
    "cameras": {"cameras": [{"name": "wrist", "K": MATRIX, "D": D}, {"K": RIGHT}]},
    "lists beside": {"left": {"K": MATRIX}, "right": {"K": RIGHT}, "left_D": D},
    "beside a block": {"K": MATRIX, "D": D, "rear": {"K": RIGHT, "D": [0] * 5}},
    "rectified": {"K_raw": MATRIX, "D_raw": D, "K_rect": RIGHT, "rms": 0.2},
    "numbers": {
        **{f"{key}_left": value for key, value in (PLAIN | DIST).items()},
        **{f"{key}_right": 600.0 for key in ("fx", "fy")},
        "cx_right": 320,
        "cy_right": 240,
    },
    "numbered": {"cam0_K": MATRIX, "cam0_D": D, "cam1_K": RIGHT, "cam1_D": D},
}
FIRST = ("M1", "mtx_l", "wrist", "left", "K D", "K_raw", "fx_left", "cam0")


@pytest.mark.parametrize(("name", "word"), [*zip(SEVERAL, FIRST, strict=True)])
def test_one_of_several_cameras_is_named(tmp_path: Path, name: str, word: str) -> None:
    file = written(tmp_path, json.dumps(SEVERAL[name]))
    refused(
        rf"holds 2 cameras: .*{word}.* \(640x480, fx 525\.0\)", read_camera, file, SIZE
    )
    assert read_camera(f"{file}:{word}", SIZE) == CAMERA
    refused("no camera 'nowhere', only", read_camera, f"{file}:nowhere", SIZE)


def test_stereo_cameras_are_named_by_their_keys(tmp_path: Path) -> None:
    file = written(tmp_path, json.dumps(SEVERAL["stereo"]))
    refused(r"holds 2 cameras: M1 D1 \(.*, M2 D2 .*FILE:M1", read_camera, file, SIZE)
    np.savez(tmp_path / "s.npz", **SEVERAL["left and right"])  # pyright: ignore[reportArgumentType]
    refused("mtx_r dist_r", read_camera, tmp_path / "s.npz", SIZE)
