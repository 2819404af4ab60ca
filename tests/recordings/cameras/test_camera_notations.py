"""Camera files of SDKs and programs: texts of many notations give the same camera."""

import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evercal.geometry import Camera
from evercal.recordings.cameras.camera_file import check_size, read_camera
from evercal.recordings.cameras.radial_models import image_radius

from ..checks import refused
from . import camera_texts as texts
from .test_camera_file import CAMERA, FLAT, SIZE, D, K, written

IMAGES = (640, 480)
PLAIN = {"fx": CAMERA.fx, "fy": CAMERA.fy, "cx": CAMERA.cx, "cy": CAMERA.cy}
COLUMNS = CAMERA.matrix().T.ravel().tolist()
KB4 = dict(zip(("k1", "k2", "k3", "k4"), D[:4], strict=True))
RADTAN = {
    "focal_length": CAMERA.fx, "aspect_ratio": CAMERA.fy / CAMERA.fx, "skew": 0.0,
    "principal_pt_x": CAMERA.cx, "principal_pt_y": CAMERA.cy,
}  # fmt: skip
RECORDS = {
    "openicc": {
        "final_reproj_error": 0.17, "fps": 60.0, "nr_calib_images": 129, **SIZE,
        "intrinsic_type": "PINHOLE_RADIAL_TANGENTIAL", "stabelized": False,
        "intrinsics": {
            **RADTAN, "radial_distortion_1": D[0], "radial_distortion_2": D[1],
            "radial_distortion_3": D[4], "tangential_distortion_1": D[2],
            "tangential_distortion_2": D[3],
        },
    },
    "depthai": {
        "batchName": "", "boardConf": "nIR-C00M00-00", "boardOptions": 7,
        "cameraData": [
            [0, {
                "cameraType": 0, "width": 1920, "height": 1080, "lensPosition": 130,
                "intrinsicMatrix": [[1500, 0, 960], [0, 1500, 540], [0, 0, 1]],
                "distortionCoeff": [1.1] * 8 + [0] * 6, "specHfovDeg": 68.8,
            }],
            [1, {
                "cameraType": 0, "width": 640, "height": 480, "lensPosition": 0,
                "intrinsicMatrix": K, "distortionCoeff": [*D] + [0] * 9, "specHfovDeg": 72,
                "extrinsics": {
                    "rotationMatrix": np.eye(3).tolist(), "toCameraSocket": 0,
                    "specTranslation": {"x": -7.5, "y": 0, "z": 0}, "lengthUnit": 1,
                    "translation": {"x": -7.4, "y": 0.1, "z": 0.02},
                },
            }],
        ],
        "imuExtrinsics": {"rotationMatrix": np.eye(3).tolist(), "toCameraSocket": 0},
        "stereoRectificationData": {"leftCameraSocket": 1, "rightCameraSocket": 2},
        "version": 7,
    },
    "list": [{"name": "wrist", "K": K, "dist": D, **SIZE}],
    "toolbox": {"camera": {"u0": 1}, "cam_matrix": K, "distCoeffs": D},
}  # fmt: skip
RECORDS["toolbox"].pop("camera")
IDEAL = {
    "polycam": {
        **PLAIN, "width": 640, "height": 480, "blur_score": 123.4, "t_00": 0.9, "t_23": 1.2,
        "timestamp": 123456, "neighbors": [1, 2], "center_depth": 1.5, "camera_index": 0,
    },
    "arkit": {
        "intrinsics": COLUMNS, "imageResolution": [640, 480], "projectionMatrix": [0.1] * 16,
        "cameraPoseARFrame": np.eye(4).ravel().tolist(), "exposureDuration": 0.01,
        "lightEstimate": {"ambientIntensity": 1000.0, "ambientColorTemperature": 6500},
    },
    "record3d": {
        "w": 640, "h": 480, "K": COLUMNS, "fps": 60, "dw": 256, "dh": 192, "cameraType": 1,
        "initPose": [0, 0, 0, 1, 0.1, 0.2, 0.3], "poses": [[0, 0, 0, 1, 0.1, 0.2, 0.3]] * 3,
    },
    "open3d": {"width": 640, "height": 480, "intrinsic_matrix": COLUMNS, "color_mode": "MJPG"},
}  # fmt: skip


@pytest.mark.parametrize("name", texts.ALL)
def test_texts_of_programs_give_the_same_camera(tmp_path: Path, name: str) -> None:
    camera = read_camera(written(tmp_path, texts.ALL[name]), IMAGES)
    assert camera.size == IMAGES
    np.testing.assert_allclose(camera.matrix(), CAMERA.matrix(), rtol=1e-12)
    np.testing.assert_allclose(camera.coefficients, CAMERA.coefficients, rtol=1e-12)


@pytest.mark.parametrize("name", [*RECORDS, *IDEAL])
def test_records_of_programs_give_the_same_camera(tmp_path: Path, name: str) -> None:
    text = json.dumps(RECORDS.get(name) or IDEAL[name])
    camera = read_camera(written(tmp_path, text), IMAGES)
    expected = CAMERA if name in RECORDS else CAMERA.pinhole
    assert camera.coefficients == expected.coefficients
    np.testing.assert_allclose(camera.matrix(), CAMERA.matrix(), rtol=1e-12)


def test_fisheyes_of_basalt_and_openicc(tmp_path: Path) -> None:
    fisheye = replace(CAMERA, distortion=tuple(D[:4]), model="fisheye")
    basalt = {
        "value0": {
            "T_imu_cam": [{"px": 0.1, "py": 0, "pz": 0, "qx": 0, "qy": 0, "qz": 0, "qw": 1}],
            "intrinsics": [{"camera_type": "kb4", "intrinsics": {**PLAIN, **KB4}}],
            "resolution": [[640, 480]], "calib_accel_bias": [0.1] * 9, "vignette": [],
            "imu_update_rate": 200.0, "cam_time_offset_ns": 12,
        }
    }  # fmt: skip
    radial = {f"radial_distortion_{i + 1}": D[i] for i in range(4)}
    gopro = {**SIZE, "intrinsic_type": "FISHEYE", "intrinsics": {**RADTAN, **radial}}
    for record in (basalt, gopro):
        camera = read_camera(written(tmp_path, json.dumps(record)))
        assert camera.distortion == fisheye.distortion
        assert (camera.model, camera.fy) == ("fisheye", pytest.approx(CAMERA.fy))
    two = basalt["value0"]
    two["intrinsics"] += [
        {"camera_type": "kb4", "intrinsics": {**PLAIN, **KB4, "fx": 500}}
    ]
    two["resolution"] += [[512, 512]]
    file = written(tmp_path, json.dumps(basalt))
    assert read_camera(file, (512, 512)).fx == 500
    assert read_camera(f"{file}:intrinsics[0]").fx == CAMERA.fx


@pytest.mark.parametrize(
    ("kind", "own"),
    [
        ("DOUBLE_SPHERE", {"xi": -0.2, "alpha": 0.6}),
        ("EXTENDED_UNIFIED", {"alpha": 0.6, "beta": 1.1}),
        ("DIVISION_UNDISTORTION", {"div_undist_distortion": -1.5e-6}),
    ],
)
def test_models_with_named_parameters_become_the_nearest_fisheye(
    tmp_path: Path, kind: str, own: dict[str, float]
) -> None:
    focal = 300.0
    inner = {"focal_length": focal, "aspect_ratio": 1.0, "skew": 0.0, **own}
    centre = {"principal_pt_x": 320.0, "principal_pt_y": 240.0}
    record = {**SIZE, "intrinsic_type": kind, "intrinsics": {**inner, **centre}}
    camera = read_camera(written(tmp_path, json.dumps(record)))
    angles = np.deg2rad(np.linspace(1, 50, 30))
    short = {"DOUBLE_SPHERE": "ds", "EXTENDED_UNIFIED": "eucm"}.get(kind, "division")
    numbers = [*own.values()]
    if short == "division":
        numbers = [numbers[0] * focal**2]
        ideal = np.tan(angles)
        distorted = focal * image_radius(short, angles, numbers)
        np.testing.assert_allclose(
            distorted / (1 + own["div_undist_distortion"] * distorted**2), focal * ideal
        )
    points = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], -1)
    radii = focal * image_radius(short, angles, numbers)
    np.testing.assert_allclose(camera.project(points)[:, 0] - 320.0, radii, atol=0.05)


def test_several_streams_and_modes_are_named(tmp_path: Path) -> None:
    file = written(tmp_path, texts.ZED)
    for size, word, fx in (
        (IMAGES, "LEFT_CAM_VGA", 525.25),
        ((1280, 720), "LEFT_CAM_HD", 700.1),
    ):
        message = rf"holds 4 cameras: LEFT_CAM_HD .*RIGHT_CAM_VGA .*FILE:{word}"
        refused(message, read_camera, file, size)
        assert read_camera(f"{file}:{word}", size).fx == fx
    assert read_camera(f"{file}:left_cam_vga", IMAGES) == CAMERA
    file = written(tmp_path, texts.ENUMERATED)
    assert read_camera(file, (1280, 720)) == Camera(
        1280, 720, 600.5, 600.25, 639.5, 359.5
    )
    refused(r'Intrinsic of "Color" / 640x480', read_camera, file)


REFUSED = {
    "mrcal splined": (
        texts.MRCAL.replace("OPENCV5", "SPLINED_STEREOGRAPHIC_order=3_Nx=30"),
        "'LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=30' is not supported",
    ),
    "mrcal cahvor": (
        texts.MRCAL.replace("OPENCV5", "CAHVOR"), "'LENSMODEL_CAHVOR' is not supported"
    ),
    "azure kinect": (
        json.dumps({"Cameras": [{"Intrinsics": {"ModelParameters": [0.5] * 14}}]}),
        "raw calibration of an Azure Kinect.* of the mode of the images",
    ),
    "halcon": ("ParGroup: Cam_Par: Internal;\nFocus:foc: 0.008;\n", "parameters of HALCON"),
    "opensfm": (
        json.dumps({"v2 gopro": {"focal_x": 0.85, "focal_y": 0.85, "cx": 0, "cy": 0}}),
        "give them in pixels",
    ),
    "skew": (json.dumps({**PLAIN, "skew": 0.5}), "'skew' is not known"),
    "skew of a sphere": (
        json.dumps({**PLAIN, "skew": 0.5, "camera_type": "ds", "xi": 0.1, "alpha": 0.5}),
        "'skew' is not known",
    ),
    "thin prism": (texts.COLMAP.replace("FULL_OPENCV", "THIN_PRISM_FISHEYE"), "THIN_PRISM_"),
    "metashape, b2": (
        texts.METASHAPE.replace("<k1>", "<b2>0.4</b2><k1>"), "'b2' is not known"
    ),
    "cut short": ("fx: 525\ndistortion: [0.1, -0.0", r"^[^\n]*not valid YAML \(line 2\); give"),
    "twice": ("fx 500\nfy 500\ncx 320\ncy 240\nfx 600\n", "not valid YAML|no camera in it"),
    "broken json": ('{"fx": 525,\n "fy": }', r"not valid JSON \(line 2\); give"),
    "broken xml": ("<camera><fx>5</camera>", r"not valid XML \(line 1\); give"),
    "words": ("see the manual", "no camera in it"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_other_texts_are_refused_in_plain_words(tmp_path: Path, name: str) -> None:
    text, message = REFUSED[name]
    refused(message, read_camera, written(tmp_path, text), IMAGES)


def test_matlab_counts_from_one(tmp_path: Path) -> None:
    (tmp_path / "c.mat").write_bytes(
        b"MATLAB 5.0 MAT-file, Platform: GLNXA64" + bytes(99)
    )
    refused(
        r"MATLAB's pixels start at \(1, 1\)", read_camera, tmp_path / "c.mat", IMAGES
    )


def test_long_texts_cost_little(tmp_path: Path) -> None:
    blank = " " * 100_000
    began = time.process_time()
    for text in (
        f"a{blank}b\n[{'a' * 100_000}\n]",
        f"[1{',' * 100_000}]",
        f"a{blank}: 1\n",
    ):
        refused("give|limits", read_camera, written(tmp_path, text), IMAGES)
    frames = {f"{i:06d}": {**PLAIN, "pose": [0.1] * 16} for i in range(3000)}
    refused("holds 3000 cameras", read_camera, written(tmp_path, json.dumps(frames)))
    assert time.process_time() - began < 10


def test_an_attribute_does_not_hide_a_number(tmp_path: Path) -> None:
    text = (
        '<c><fx>500</fx><fy>500</fy><cx>320</cx><cy>240</cy><k1 unit="px">0.1</k1></c>'
    )
    refused("'k1.text' is not known", read_camera, written(tmp_path, text), IMAGES)


def test_another_size_is_said_to_be_a_resize_or_a_cut(tmp_path: Path) -> None:
    camera = Camera(1280, 960, 1050.0, 1050.0, 639.5, 479.5)
    message = (
        r"1280x960, a.png is 640x480 \(resized, with fx 525.0, cx 319.5, cy 239.5\?\)"
    )
    refused(message, check_size, "c.json", camera, IMAGES, "a.png")
    wide = Camera(1280, 720, 900.0, 900.0, 639.5, 359.5)
    message = r"is 640x480 \(squeezed or cut out from 1280x720\?\)"
    refused(message, check_size, "c.json", wide, IMAGES, "a.png")
    assert FLAT


WIDTH = {"width": 640, "height": 480}
VIEWS = {
    "mujoco": ('<camera name="a" pos="0 0 1" quat="1 0 0 0" fovy="45"/>', 579.41, 319.5, 239.5),
    "mujoco, sensor": (
        '<camera resolution="640 480" sensorsize="6.4e-3 4.8e-3" focal="5e-3 5e-3"/>',
        500.0, 319.5, 239.5,
    ),
    "isaac": ({"focal_length": 24, "horizontal_aperture": 20.955, **WIDTH}, 733.0, 319.5, 239.5),
    "blender": (
        {"lens": 35, "sensor_width": 36, "shift_x": 0.05, "shift_y": 0.03, **WIDTH},
        622.22, 287.5, 258.7,
    ),
    "blender, upright": (
        {"lens": 35, "sensor_width": 36, "resolution_x": 480, "resolution_y": 640},
        622.22, 239.5, 319.5,
    ),
    "blender, vertical": (
        {"lens": 35, "sensor_width": 36, "sensor_height": 24, "sensor_fit": "VERTICAL", **WIDTH},
        700.0, 319.5, 239.5,
    ),
    "gazebo": (
        "<camera><horizontal_fov>1.047</horizontal_fov><image><width>640</width>"
        "<height>480</height></image><clip><near>0.02</near></clip></camera>",
        554.38, 319.5, 239.5,
    ),
    "habitat": ({"hfov": 90, **WIDTH}, 320.0, 319.5, 239.5),
    "maniskill": ({"uid": "hand", "fov": 1.5708, "width": 128, "height": 128}, 64.0, 63.5, 63.5),
    "nerf": ({"camera_angle_x": 0.69}, 890.44, 319.5, 239.5),
    "both": ({"fovx": 60, "fovy": 46.826, **WIDTH}, 554.26, 319.5, 239.5),
}  # fmt: skip


@pytest.mark.parametrize("name", VIEWS)
def test_fields_of_view_of_simulators_are_read(tmp_path: Path, name: str) -> None:
    content, focal, cx, cy = VIEWS[name]
    text = content if isinstance(content, str) else json.dumps(content)
    size = None if "width" in text and name != "maniskill" else IMAGES
    camera = read_camera(written(tmp_path, text), size)
    assert (camera.cx, camera.cy) == (pytest.approx(cx), pytest.approx(cy))
    assert (camera.fx, camera.fy) == (pytest.approx(focal, abs=0.01),) * 2


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"fov": 60, **WIDTH}, "'fov' 60 may be that of the width or of the height"),
        ({"fovy": 0, **WIDTH}, "the field of view, or the sensor, has no size"),
        ({**RADTAN, "aspect_ratio": 0, **WIDTH}, "fx, fy.*got 0"),
        ({"fovy": "wide", **WIDTH}, "fov_y is a number, got 'wide'"),
        ({"lens": 35, "sensor_width": 0, **WIDTH}, "the sensor, has no size"),
        (
            {"lens": 35, "sensor_width": 36, "sensor_fit": "VERTICAL", **WIDTH},
            "has no size",
        ),
        (
            {"focal_length": [1, 2, 3], "horizontal_aperture": 20, **WIDTH},
            "focal is a number",
        ),
        (
            {
                "focal_length": 24,
                "horizontal_aperture": 21,
                "horizontal_aperture_offset": 0.5,
            },
            "'horizontal_aperture_offset' is not known",
        ),
        ({"fovy": 45, "distortion_k": 0.2}, "'distortion_k' is not known"),
    ],
)
def test_broken_fields_of_view_are_refused(
    tmp_path: Path, fields: dict[str, object], message: str
) -> None:
    refused(message, read_camera, written(tmp_path, json.dumps(fields)), IMAGES)
