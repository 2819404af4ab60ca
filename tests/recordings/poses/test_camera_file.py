"""Intrinsics from text, JSON and ROS files: the same camera from each, and damage named."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.recordings.poses.camera_file import read_camera

from ..checks import refused

CAMERA = Camera(640, 480, 525.25, 526.5, 319.5, 239.25, (0.1, -0.02, 0.001, 1e-5, 0.03))

CALIBRATION = """\
# made by camera_calibration
image_width: 640
image_height: 480
camera_name: front
camera_matrix:
  rows: 3
  cols: 3
  data: [525.25, 0, 319.5, 0, 526.5, 239.25, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.1, -0.02, 0.001, 1e-05, 0.03]
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
projection_matrix: {rows: 3, cols: 4, data: [500, 0, 310, 0, 0, 500, 240, 0, 0, 0, 1, 0]}
"""

MESSAGE = """\
header:
  stamp: {sec: 1, nanosec: 2}
  frame_id: front_optical
height: 480
width: 640
distortion_model: rational_polynomial
d:
- 0.1
- -0.02
- 0.001
- 1.0e-05
- 0.03
- 0.0
- 0.0
- 0.0
k: [525.25, 0.0, 319.5, 0.0, 526.5, 239.25, 0.0, 0.0, 1.0]
roi: {x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}
---
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "camera.any"
    path.write_text(text, encoding="utf-8")
    return path


def test_every_kind_gives_the_same_camera(tmp_path: Path) -> None:
    ideal = Camera(640, 480, CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)
    matrix = tmp_path / "k.txt"
    np.savetxt(matrix, CAMERA.matrix(), header="left camera")
    assert read_camera(matrix, (640, 480)) == ideal
    commas = written(tmp_path, "525.25, 0, 319.5\n0, 526.5, 239.25\n0, 0, 1  # pixels\n")
    assert read_camera(commas, (640, 480)) == ideal
    assert read_camera(written(tmp_path, json.dumps(CAMERA.to_dict()))) == CAMERA
    assert read_camera(written(tmp_path, CALIBRATION)) == CAMERA
    assert read_camera(written(tmp_path, MESSAGE)) == Camera(
        640, 480, CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, (*CAMERA.distortion, 0.0, 0.0, 0.0)
    )


def stored(folder: Path, ending: str = "yml", size: bool = True, **more: object) -> Path:
    """What cv2.FileStorage writes of the camera."""
    path = folder / f"stored.{ending}"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    values = {
        "camera_matrix": CAMERA.matrix(),
        "dist_coeffs": np.array([CAMERA.distortion]),
        **more,
    }
    if size:
        values |= {"image_Width": CAMERA.width, "image_Height": CAMERA.height}
    for name, value in values.items():
        storage.write(name, value)  # pyright: ignore[reportArgumentType, reportCallIssue]
    storage.release()
    return path


def test_opencv_storage_is_read(tmp_path: Path) -> None:
    assert read_camera(stored(tmp_path, "xml")) == CAMERA
    yaml = stored(tmp_path, fisheye_model=0, board="9x6")
    assert read_camera(yaml, (320, 240)) == CAMERA
    old = yaml.read_text().replace("%YAML 1.2", "%YAML:1.0")
    assert read_camera(written(tmp_path, old)) == CAMERA
    assert read_camera(stored(tmp_path, size=False), (640, 480)) == CAMERA
    refused("'image_width' is missing", read_camera, stored(tmp_path, size=False))
    for more, expected in (
        ({"fisheye_model": 1}, "fisheye_model is set"),
        ({"K": np.eye(3)}, "camera_matrix and K are the same; keep one"),
        ({"camera_matrix": np.eye(2)}, "camera_matrix has 9 numbers, got 4"),
    ):
        with pytest.raises(InputError, match=expected):
            read_camera(stored(tmp_path, **more))  # pyright: ignore[reportArgumentType]
    stereo = old.replace("camera_matrix", "M1").replace("dist_coeffs", "D1")
    for text, expected in (
        (stereo, "'camera_matrix' is missing, there is M1, D1, fisheye_model"),
        (old[:120], "not valid YAML"),
        ("<opencv_storage><a>", "not valid XML"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><opencv_storage/>', "declares XML entities"),
    ):
        refused(expected, read_camera, written(tmp_path, text), (640, 480))


def test_ros_files_state_their_distortion(tmp_path: Path) -> None:
    text = CALIBRATION.replace("distortion_coefficients", "lens")
    refused("'distortion_coefficients' is missing", read_camera, written(tmp_path, text))
    assert read_camera(written(tmp_path, text + "d: [0, 0, 0, 0]\n")).distortion == ()
    old = MESSAGE.replace("d:\n", "D:\n").replace("k: [", "K: [")  # ROS 1
    assert read_camera(written(tmp_path, old)).fx == CAMERA.fx
    longer = CALIBRATION.replace("1e-05, 0.03]", "1e-05, 0.03, 0, 0, 0, 0, 0, 0, 0]")
    assert read_camera(written(tmp_path, longer)).distortion == (*CAMERA.distortion, 0, 0, 0)


def test_a_single_number_called_size_is_no_image_size(tmp_path: Path) -> None:
    matrix = [[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]
    np.savez(tmp_path / "camera.npz", K=matrix, dist=np.zeros(5), size=0.025)
    camera = read_camera(tmp_path / "camera.npz", (640, 480))
    assert (camera.fx, camera.width, camera.height) == (500, 640, 480)
    refused("no image size", read_camera, tmp_path / "camera.npz")


def test_missing_camera_file_is_refused(tmp_path: Path) -> None:
    refused("missing", read_camera, tmp_path / "none.yaml")
    refused("cannot be read", read_camera, tmp_path)
    (tmp_path / "image.png").write_bytes(b"\x89PNG\xff\xfe")
    refused("not a text file", read_camera, tmp_path / "image.png")
    refused("no image size", read_camera, written(tmp_path, "1 0 0 0 1 0 0 0 1"))


def test_yaml_cannot_run_code(tmp_path: Path) -> None:
    bait = tmp_path / "bait"
    text = f"width: !!python/object/apply:os.mkdir ['{bait}']\n"
    refused("tags", read_camera, written(tmp_path, text))
    assert not bait.exists()


K, D = CAMERA.matrix().tolist(), list(CAMERA.distortion)
FLAT = [value for row in K for value in row]
SIZE = {"image_width": 640, "image_height": 480}
REALSENSE = {"fx": 525.25, "fy": 526.5, "ppx": 319.5, "ppy": 239.25, "width": 640, "height": 480}
FIELDS = [
    {"camera_matrix": K, "dist_coeffs": [D], **SIZE},
    {"camera_matrix": FLAT, "dist_coeff": D, "image_size": [640, 480]},
    {"camera_matrix": {"rows": 3, "cols": 3, "data": FLAT}, "dist": D, "resolution": [640, 480]},
    {"K": K, "D": D, "img_size": {"width": 640, "height": 480}},
    {"mtx": K, "dist": [[d] for d in D]},
    {"K": K, "distortion": D, "width": 640, "height": 480},
    {"intrinsic_matrix": CAMERA.matrix().T.ravel().tolist(), "distortion_coefficients": D},
    {**REALSENSE, "coeffs": D, "model": "distortion.brown_conrady"},
    {**CAMERA.to_dict(), "k1": 0.5},
    {"fx": 525.25, "fy": 526.5, "cx": 319.5, "cy": 239.25,
     **dict(zip(("k1", "k2", "p1", "p2", "k3"), D, strict=True))},
]  # fmt: skip


@pytest.mark.parametrize("fields", FIELDS)
def test_fields_of_json_yaml_and_npz_give_the_same_camera(
    tmp_path: Path, fields: dict[str, object]
) -> None:
    assert read_camera(written(tmp_path, json.dumps(fields)), (640, 480)) == CAMERA
    assert read_camera(written(tmp_path, yaml.safe_dump(fields)), (640, 480)) == CAMERA
    if not any(isinstance(value, (dict, str)) for value in fields.values()):
        np.savez(tmp_path / "c.npz", **fields)  # pyright: ignore[reportArgumentType]
        assert read_camera(tmp_path / "c.npz", (640, 480)) == CAMERA


def test_files_with_a_matrix_alone_have_no_distortion(tmp_path: Path) -> None:
    ideal = CAMERA.pinhole
    realsense = {**REALSENSE, "coeffs": [0.0] * 5, "model": "Inverse Brown Conrady"}
    for fields in ({"camera_matrix": K}, K, realsense):
        assert read_camera(written(tmp_path, json.dumps(fields)), (640, 480)) == ideal
    assert read_camera(written(tmp_path, str(CAMERA.matrix())), (640, 480)) == ideal
    assert read_camera(stored(tmp_path, dist_coeffs=np.zeros(5))) == ideal


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("1 2 3", "camera_matrix has 9 numbers, got 3"),
        ("1: 2\nfx: 5\n", "camera 'fy' is missing"),
        ("1 2 3 4 5 6 7 8 9", "fx 0 cx"),
        ("nan 0 0 0 1 0 0 0 1", "finite"),
        ("hello world", "no camera in it"),
        ("a: [1", "not valid YAML"),
        ("{'single': 'quotes'}", "not valid JSON"),
        ('{"width": 640}', "'camera_matrix' is missing, there is width"),
        ('{"fx": 1, "fy": 1, "cx": 1, "cy": 1, "width": 640}', "'image_height' is missing"),
        (CALIBRATION.replace("image_width", "breadth"), "'image_width' is missing"),
        (CALIBRATION.replace("640", "wide"), "image size"),
        (CALIBRATION.replace("640", "0"), "width"),
        (CALIBRATION.replace("plumb_bob", "equidistant"), "equidistant"),
        (CALIBRATION.replace("[525.25, 0,", "[525.25,"), "9 numbers, got 8"),
        (CALIBRATION.replace("[0.1, -0.02,", "[true, -0.02,"), "distortion_coefficients"),
        (CALIBRATION.replace("0.03]", "0.03, 0.5, 0.5]"), "0, 4, 5 or 8"),
        (MESSAGE.replace("x_offset: 0", "x_offset: 8"), "cut-out"),
        (MESSAGE.replace("525.25", "0.0"), "fx"),
        ({"K": K, "D": D}, "'image_width' is missing .no image size"),
        ({"K": K, "D": D, "width": 640}, "'image_height' is missing"),
        ({"K": K, "distortion_parameters": D, **SIZE}, "there is distortion_parameters"),
        ({"K": K, "dist": D, "d": D, **SIZE}, "dist and d are the same; keep one"),
        ({"K": K, "image_size": [480, 640, 3]}, r"image size \(width, height\) has 2 numbers"),
        ({**REALSENSE, "coeffs": D, "model": "inverse_brown_conrady"}, "is not supported"),
        ({**REALSENSE, "coeffs": [0] * 5, "model": "kannala_brandt4"}, "is not supported"),
        ({"K": K[:2], **SIZE}, "camera_matrix has 9 numbers, got 6"),
    ],
)
def test_broken_files_are_refused(
    tmp_path: Path, content: str | dict[str, object], expected: str
) -> None:
    path = written(tmp_path, content if isinstance(content, str) else json.dumps(content))
    size = (640, 480) if isinstance(content, str) else None
    with pytest.raises(InputError, match=expected) as caught:
        read_camera(path, size)
    assert str(caught.value).startswith(f"{path}: ")
