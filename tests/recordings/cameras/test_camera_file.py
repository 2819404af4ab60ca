"""Intrinsics from text, JSON and ROS files: the same camera from each, and damage named."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from evercal.calibration.boards.board_poses import BoardPoses
from evercal.calibration.boards.detection import Board
from evercal.calibration.calibration import Calibration
from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings.cameras.camera_file import read_camera

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
    commas = written(
        tmp_path, "525.25, 0, 319.5\n0, 526.5, 239.25\n0, 0, 1  # pixels\n"
    )
    assert read_camera(commas, (640, 480)) == ideal
    assert read_camera(written(tmp_path, json.dumps(CAMERA.to_dict()))) == CAMERA
    assert read_camera(written(tmp_path, CALIBRATION)) == CAMERA
    assert read_camera(written(tmp_path, MESSAGE)) == Camera(
        640,
        480,
        CAMERA.fx,
        CAMERA.fy,
        CAMERA.cx,
        CAMERA.cy,
        (*CAMERA.distortion, 0.0, 0.0, 0.0),
    )


def stored(
    folder: Path, ending: str = "yml", size: bool = True, **more: object
) -> Path:
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
        ({"fisheye_model": 1}, "has 0 or 4 finite coefficients"),
        ({"K": np.eye(3)}, "camera_matrix and K are the same; keep one"),
        ({"camera_matrix": np.eye(2)}, "camera_matrix has 9 numbers, got 4"),
    ):
        with pytest.raises(InputError, match=expected):
            read_camera(stored(tmp_path, **more))  # pyright: ignore[reportArgumentType]
    first = old.replace("camera_matrix", "M1").replace("dist_coeffs", "D1")
    assert read_camera(written(tmp_path, first)) == CAMERA
    for text, expected in (
        (old[:120], "not valid YAML"),
        ("<opencv_storage><a>", "not valid XML"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><opencv_storage/>', "declares XML entities"),
    ):
        refused(expected, read_camera, written(tmp_path, text), (640, 480))


def test_ros_files_state_their_distortion(tmp_path: Path) -> None:
    text = CALIBRATION.replace("0.1, -0.02, 0.001, 1e-05, 0.03", "0, 0, 0, 0, 0")
    other = text.replace("distortion_coefficients", "lens")
    refused(
        "'distortion_coefficients' is missing", read_camera, written(tmp_path, other)
    )
    assert read_camera(written(tmp_path, text)).distortion == ()
    assert (
        read_camera(written(tmp_path, other.replace("plumb_bob", "none"))).distortion
        == ()
    )
    old = MESSAGE.replace("d:\n", "D:\n").replace("k: [", "K: [")  # ROS 1
    assert read_camera(written(tmp_path, old)).fx == CAMERA.fx
    longer = CALIBRATION.replace("1e-05, 0.03]", "1e-05, 0.03, 0, 0, 0, 0, 0, 0, 0]")
    assert read_camera(written(tmp_path, longer)).distortion == (
        *CAMERA.distortion,
        0,
        0,
        0,
    )


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


K = CAMERA.matrix().tolist()
D = list(CAMERA.distortion)
FLAT = [value for row in K for value in row]
SIZE = {"image_width": 640, "image_height": 480}
REALSENSE = {
    "fx": 525.25,
    "fy": 526.5,
    "ppx": 319.5,
    "ppy": 239.25,
    "width": 640,
    "height": 480,
}
FIELDS = [
    {"camera_matrix": K, "dist_coeffs": [D], **SIZE},
    {"camera_matrix": FLAT, "dist_coeff": D, "image_size": [640, 480]},
    {"camera_matrix": {"rows": 3, "cols": 3, "data": FLAT}, "dist": D, "resolution": [640, 480]},
    {"K": K, "D": D, "img_size": {"width": 640, "height": 480}},
    {"mtx": K, "dist": [[d] for d in D]},
    {"K": K, "distortion": D, "width": 640, "height": 480},
    {"intrinsic_matrix": CAMERA.matrix().T.ravel().tolist(), "distortion_coefficients": D},
    {**REALSENSE, "coeffs": D, "model": "distortion.brown_conrady"},
    {**CAMERA.to_dict(), "k1": 0.0},
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


def test_a_camera_may_stand_inside_other_entries(tmp_path: Path) -> None:
    numbers = {"fx": CAMERA.fx, "fy": CAMERA.fy, "cx": CAMERA.cx, "cy": CAMERA.cy}
    named = dict(zip(("k1", "k2", "p1", "p2", "k3"), D, strict=True))
    for fields in (
        {"camera": CAMERA.to_dict(), "matrix": np.eye(4).tolist(), "sigma_mm": 0.4},
        {"camera_info": {"K": K, "D": D, **SIZE}},
        {"intrinsics": numbers, "distortion": named, **SIZE},
        {
            "cameras": [{"name": "left", "intrinsics": {**numbers, **named}}],
            "resolution": [640, 480],
        },
        {"rig": {"front": {"K": K}}, "dist": D, **SIZE},
        {"K": [*FLAT[:3], 0, *FLAT[3:6], 0, *FLAT[6:], 0, 0, 0, 0, 1], "kc": D, **SIZE},
    ):
        assert read_camera(written(tmp_path, json.dumps(fields))) == CAMERA
        assert read_camera(written(tmp_path, yaml.safe_dump(fields))) == CAMERA


def test_detected_boards_and_calibrations_are_camera_files(tmp_path: Path) -> None:
    file = tmp_path / "saved.json"
    Calibration("eye_to_hand", SE3.identity(), np.eye(6), camera=CAMERA).write(file)
    assert read_camera(file, (640, 480)) == CAMERA
    BoardPoses(Board("chessboard", 0.025, 9, 6), CAMERA, (), 0.1).write(file)
    assert read_camera(file, (640, 480)) == CAMERA


def test_opencv_stores_a_camera_inside_a_map(tmp_path: Path) -> None:
    for ending in ("yml", "xml", "json"):
        file = str(tmp_path / f"nested.{ending}")
        storage = cv2.FileStorage(file, cv2.FILE_STORAGE_WRITE)
        storage.write("board", "9x6")
        storage.startWriteStruct("left", cv2.FileNode_MAP)
        storage.write("K", CAMERA.matrix())
        storage.write("D", np.array(D))  # OpenCV 5 writes opencv-nd-matrix
        storage.startWriteStruct("resolution", cv2.FileNode_SEQ | cv2.FileNode_FLOW)
        storage.write("", 640)
        storage.write("", 480)
        storage.endWriteStruct()
        storage.endWriteStruct()
        storage.release()
        assert read_camera(file) == CAMERA


def test_binned_pixels_shrink_the_intrinsics(tmp_path: Path) -> None:
    file = written(
        tmp_path, MESSAGE.replace("roi:", "binning_x: 2\nbinning_y: 2\nroi:")
    )
    half = replace(CAMERA, distortion=(*CAMERA.distortion, 0.0, 0.0, 0.0)).resized(
        320, 240
    )
    assert read_camera(file) == read_camera(file, (320, 240)) == half
    # Of drivers that state the image's size.
    assert read_camera(file, (640, 480)).fx == CAMERA.fx


def test_a_focal_length_alone_has_its_principal_point_in_the_middle(
    tmp_path: Path,
) -> None:
    assert read_camera(written(tmp_path, "525.25\n"), (640, 480)) == Camera(
        640, 480, 525.25, 525.25, 319.5, 239.5
    )


def test_no_distortion_may_be_stated_in_words(tmp_path: Path) -> None:
    for fields in (
        {"distortion": None},
        {"dist": "none"},
        {"model": "none"},
        {"model": None},
    ):
        file = written(tmp_path, yaml.safe_dump({"K": K, **SIZE, **fields}))
        assert read_camera(file) == CAMERA.pinhole


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("1 2 3", "camera_matrix has 9 numbers, got 3"),
        ("1: 2\nfx: 5\n", "camera 'fy' is missing"),
        ("1 2 3 4 5 6 7 8 9", "fx 0 cx"),
        ("nan 0 0 0 1 0 0 0 1", "finite"),
        ("hello world", "no camera in it"),
        ("a: [1", "not valid YAML"),
        ("{'single': 'quotes'}", "'camera_matrix' is missing, there is single"),
        ('{"width": 640}', "'camera_matrix' is missing, there is width"),
        (
            '{"fx": 1, "fy": 1, "cx": 1, "cy": 1, "width": 640}',
            "'image_height' is missing",
        ),
        (CALIBRATION.replace("image_width", "breadth"), "'image_width' is missing"),
        (CALIBRATION.replace("640", "wide"), "image size"),
        (CALIBRATION.replace("640", "0"), "width"),
        (CALIBRATION.replace("plumb_bob", "fov"), "fov"),
        (CALIBRATION.replace("[525.25, 0,", "[525.25,"), "9 numbers, got 8"),
        (
            CALIBRATION.replace("[0.1, -0.02,", "[true, -0.02,"),
            "distortion_coefficients",
        ),
        (CALIBRATION.replace("0.03]", "0.03, 0.5, 0.5]"), "0, 4, 5 or 8"),
        (MESSAGE.replace("x_offset: 0", "x_offset: 8"), "cut-out"),
        (MESSAGE.replace("525.25", "0.0"), "fx"),
        ({"K": K, "D": D}, "'image_width' is missing .no image size"),
        ({"K": K, "D": D, "width": 640}, "'image_height' is missing"),
        (
            {"K": K, "radial": D[:2], **SIZE},
            "'radial' is not known and may change the image",
        ),
        ({"K": K, "lens": {"data": D}, **SIZE}, "'lens' is not known"),
        ({"K": K, "dc": [D], **SIZE}, "'dc' is not known"),
        ({"K": K, "dist_vec": D, **SIZE}, "'dist_vec' is not known"),
        ({"K": K, "r": D[:2], "D": [0] * 5, **SIZE}, "'r' is not known"),
        ({"K": K, "dist": D, "xi": 1, **SIZE}, "'xi' is not known"),
        (
            {"camera": {"K": K, **SIZE}, "tangential": [1e-3, 0]},
            "'tangential' is not known",
        ),
        ({"K": K, "distortion_params": [0.1] * 6, **SIZE}, "0, 4, 5 or 8"),
        ({"K": K, "dist": D, "model": "none", **SIZE}, "'none' is not supported with"),
        ({"intrinsics": [525, 319.5, 526, 239.3], **SIZE}, "9 numbers, got 4"),
        (
            {"fx": 4.2, "fy": 4.2, "cx": 320, "cy": 240, **SIZE},
            "fx 4.2, .* do not fit 640x480",
        ),
        ({"fx": 0.82, "fy": 1.1, "cx": 0.5, "cy": 0.5, **SIZE}, "give them in pixels"),
        (
            {"fx": 1160, "fy": 1160, "cx": 650, "cy": 480, **SIZE},
            "and of this image size",
        ),
        ({"K": K, "dist": D, "d": D, **SIZE}, "dist and d are the same; keep one"),
        ({**CAMERA.to_dict(), "k1": 0.5}, "_coefficients and k1 are both stated; keep"),
        (
            {"K": K, "image_size": [480, 640, 3]},
            r"image size \(width, height\) has 2 numbers",
        ),
        (
            {**REALSENSE, "coeffs": D, "model": "inverse_brown_conrady"},
            "is not supported",
        ),
        ({**REALSENSE, "coeffs": [0] * 5, "model": "f_theta"}, "is not supported"),
        ({"K": K[:2], **SIZE}, "camera_matrix has 9 numbers, got 6"),
    ],
)
def test_broken_files_are_refused(
    tmp_path: Path, content: str | dict[str, object], expected: str
) -> None:
    path = written(
        tmp_path, content if isinstance(content, str) else json.dumps(content)
    )
    size = (640, 480) if isinstance(content, str) else None
    with pytest.raises(InputError, match=expected) as caught:
        read_camera(path, size)
    assert str(caught.value).startswith(f"{path}: ")
