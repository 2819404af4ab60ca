"""nerfstudio's transforms.json: projections agree with its documented formulas."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from evercal.geometry import SE3, Camera
from evercal.recordings import Frame, load_recording, write_image
from evercal.recordings.formats import nerfstudio
from evercal.recordings.inspection import inspect_recording

from ..checks import refused, with_orientation

LENS = {"fl_x": 40.0, "fl_y": 42.0, "cx": 13.0, "cy": 17.5, "w": 24, "h": 36,
        "k1": 0.05, "k2": -0.02, "p1": 0.003, "p2": -0.002}  # fmt: skip


def look(
    eye: np.ndarray, target: np.ndarray, up: tuple[float, float, float]
) -> np.ndarray:
    """OpenGL's camera in the world: columns right, up, backward and where it stands."""
    back = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([right, np.cross(back, right), back, eye])
    return matrix


def gl_pixel(matrix: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Pixel of a point by `LENS`, x to the right and y down from the image's corner.

    The camera looks along -z with y up; distortion is Brown's model in the plane z = 1, y down.
    """
    x, y, z = np.linalg.solve(matrix, np.append(point, 1.0))[:3]
    assert z < 0
    u = x / -z
    v = -y / -z
    fx, fy, cx, cy, _, _, k1, k2, p1, p2 = LENS.values()
    r2 = u * u + v * v
    radial = 1 + k1 * r2 + k2 * r2 * r2
    du = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
    dv = v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v
    return np.array([fx * du + cx, fy * dv + cy])


def black(image: Path, size: tuple[int, int] = (24, 36)) -> None:
    """An image without content."""
    image.parent.mkdir(parents=True, exist_ok=True)
    write_image(image, np.zeros((*size[::-1], 3), np.uint8))


def write(
    root: Path,
    frames: list[dict[str, Any]],
    size: tuple[int, int] = (24, 36),
    **top: Any,
) -> Path:
    """Images, and the file that lists them."""
    for frame in frames:
        black(root / frame["file_path"], size)
    (root / "transforms.json").write_text(json.dumps({**top, "frames": frames}))
    return root / "transforms.json"


def first_camera(root: Path) -> Camera:
    return load_recording(root).train[0].camera


def ring(count: int = 5) -> list[np.ndarray]:
    angles = np.linspace(0, 2, count)
    eyes = [np.array([2 * np.cos(a), 2 * np.sin(a), 0.3 + 0.1 * a]) for a in angles]
    return [look(eye, np.zeros(3), (0.1, 0.0, 1.0)) for eye in eyes]


def entries(matrices: list[np.ndarray], **more: Any) -> list[dict[str, Any]]:
    return [
        {
            "file_path": f"images/frame_{i:05d}.png",
            "transform_matrix": m.tolist(),
            **more,
        }
        for i, m in enumerate(matrices)
    ]


def pixel_of(frame: Frame, point: np.ndarray) -> np.ndarray:
    """The pixel from the image's corner, by this program's own camera."""
    assert frame.base_from_camera is not None
    return frame.camera.project(frame.base_from_camera.inverse().apply(point)) + 0.5


@pytest.mark.parametrize("shared", [True, False])
def test_projections_agree_with_the_documented_formulas(
    shared: bool, tmp_path: Path
) -> None:
    matrices = ring()
    if shared:
        write(tmp_path, entries(matrices), camera_model="OPENCV", **LENS)
    else:
        write(tmp_path, entries(matrices, **LENS))
    recording = load_recording(tmp_path)
    assert (len(recording.train), recording.test) == (5, ())
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (20, 3))
    for frame, matrix in zip(recording.train, matrices, strict=True):
        assert frame.read_image().shape == (36, 24, 3)  # portrait
        for point in points:
            np.testing.assert_allclose(
                pixel_of(frame, point), gl_pixel(matrix, point), atol=1e-9
            )
    assert "are those of transforms.json" in inspect_recording(recording).notes[0]


@settings(max_examples=20)
@given(
    st.lists(st.floats(-2, 2), min_size=6, max_size=6),
    st.floats(0.2, 5),
    st.lists(st.floats(-0.4, 0.4), min_size=3, max_size=3),
)
def test_an_applied_transform_is_undone(
    tangent: list[float], scale: float, point: list[float]
) -> None:
    # What ns-process-data does to its poses: a turn, a shift, then a scale.
    applied = SE3.exp(tangent).matrix()
    data = {**LENS, "applied_transform": applied[:3].tolist(), "applied_scale": scale}
    undo, divide = nerfstudio._applied(data)
    for matrix in ring(3):
        moved = applied @ matrix
        moved[:3, 3] *= scale
        entry = {"file_path": "a.png", "transform_matrix": moved.tolist()}
        frame = nerfstudio._frame(Path(), data, entry, undo, divide)
        expected = gl_pixel(matrix, np.array(point))
        pixel = pixel_of(frame, np.array(point))
        np.testing.assert_allclose(pixel, expected, atol=1e-6)


def test_test_filenames_are_test_frames(tmp_path: Path) -> None:
    names = [f"images/frame_{i:05d}.png" for i in range(4)]
    splits: dict[str, Any] = {"train_filenames": names[:1], "val_filenames": names[1:2]}
    write(tmp_path, entries(ring()), **LENS, **splits, test_filenames=[f"./{names[3]}"])
    recording = load_recording(tmp_path)
    assert [f.name[-6:-4] for f in recording.train] == ["00", "02", "04"]
    assert [f.name[-6:-4] for f in recording.test] == ["01", "03"]
    assert load_recording(tmp_path / "transforms.json").name == tmp_path.name


def test_downscaled_images_get_scaled_cameras(tmp_path: Path) -> None:
    matrices = ring(2)
    write(tmp_path, entries(matrices), (12, 18), **LENS)
    frame = load_recording(tmp_path).train[1]
    assert (frame.camera.width, frame.camera.height) == (12, 18)
    point = np.array([0.2, -0.1, 0.3])
    # From the corner, every pixel coordinate is simply half.
    np.testing.assert_allclose(pixel_of(frame, point), gl_pixel(matrices[1], point) / 2)


@pytest.mark.parametrize(
    ("lens", "focal"),
    [
        ({"camera_angle_x": 0.5}, (12 / np.tan(0.25), 12 / np.tan(0.25))),
        ({"camera_angle_y": 0.5}, (18 / np.tan(0.25), 18 / np.tan(0.25))),
        (
            {"camera_angle_x": 0.4, "camera_angle_y": 0.5},
            (12 / np.tan(0.2), 18 / np.tan(0.25)),
        ),
        ({"fl_x": 40.0, "camera_angle_y": 0.5}, (40.0, 18 / np.tan(0.25))),
    ],
)
def test_angles_of_view_without_image_size(
    lens: dict[str, Any], focal: tuple[float, float], tmp_path: Path
) -> None:
    write(tmp_path, entries(ring(2)), **lens)
    camera = first_camera(tmp_path)
    assert (camera.fx, camera.fy) == pytest.approx(focal)
    assert (camera.width, camera.height, camera.cx, camera.cy) == (24, 36, 11.5, 17.5)


def one(matrix: np.ndarray) -> list[dict[str, Any]]:
    return [{"file_path": "a.png", "transform_matrix": matrix.tolist()}]


@pytest.mark.parametrize(
    "stated", [{"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}]
)
def test_a_fisheye_has_k1_to_k4(tmp_path: Path, stated: dict[str, Any]) -> None:
    terms = {"k1": 0.1, "k2": -0.02, "k3": 0.003, "k4": 1e-4, "p1": 0.0, "p2": 0.0}
    write(tmp_path, entries(ring(2)), **{**LENS, **terms, **stated})
    camera = first_camera(tmp_path)
    assert (camera.model, camera.distortion) == ("fisheye", (0.1, -0.02, 0.003, 1e-4))


BREAKS: list[tuple[dict[str, Any], str]] = [
    (
        {"camera_model": "EQUIRECTANGULAR"},
        "camera_model 'EQUIRECTANGULAR' is not supported, only",
    ),
    ({"is_fisheye": True, "p1": 0.1}, "with p1 and p2 0 for"),
    ({"k4": 0.1}, "with k4 0 for OPENCV"),
    ({"distortion_params": [0.1] * 4}, "distortion is k1, k2, k3, k4, p1, p2"),
    ({"distortion_params": [0.1, 0, 0, 0, 0, 0]}, "also as 'distortion_params', got"),
    ({"test_frames": {}}, "'frames' is a list"),
    ({"fl_x": None, "fl_y": None}, "'fl_x' is missing, and so are"),
    (
        {"fl_x": None, "camera_angle_x": 28.0},
        "'camera_angle_x' is between 0 and pi radians",
    ),
    ({"fl_x": 0}, "fx is finite"),
    ({"w": None}, "'w' is missing"),
    (
        {"test_filenames": ["frame_00001.png"]},
        "names 'frame_00001.png', which is no frame",
    ),
    ({"fl_x": "wide"}, "'fl_x' is a number"),
    ({"fl_x": -3}, "fx is finite"),
    ({"w": 36, "h": 24}, "is 24x36, transforms.json says 36x24 .the image was rotated"),
    ({"w": 30}, "is 24x36, transforms.json says 30x36 .cropped"),
    ({"applied_scale": 0}, "'applied_scale' is > 0"),
    ({"applied_transform": [[1, 0], [0, 1]]}, "'applied_transform' is 4x4 or 3x4"),
    (
        {"applied_transform": np.diag([1.0, 1, -1, 1]).tolist()},
        "'applied_transform': .*reflection",
    ),
    ({"applied_transform": np.diag([1.0, 0, 1, 1]).tolist()}, "cannot be undone"),
    ({"frames": []}, "'frames' is a list with at least one frame"),
    ({"frames": [3]}, "frame 0: an object with 'file_path'"),
    ({"frames": [{"file_path": "a.png"}]}, "frame 0: a.png: 'transform_matrix' is 4x4"),
    ({"frames": one(2 * np.eye(4))}, "frame 0: a.png: the last row"),
    ({"frames": one(np.diag([2, 2, 2, 1.0]))}, "frame 0: a.png: .*is a rotation"),
    ({"frames": entries(ring(1)) * 2}, "'images/frame_00000.png' comes twice"),
    ({"test_filenames": "all"}, "'test_filenames' is a list of file names"),
]


@pytest.mark.parametrize(("change", "message"), BREAKS)
def test_broken_files_are_refused(
    change: dict[str, Any], message: str, tmp_path: Path
) -> None:
    file = write(tmp_path, entries(ring(2)), **LENS)
    file.write_text(json.dumps({**json.loads(file.read_text()), **change}))
    names_the_file = r"(?=.*transforms\.json)"
    refused(f"{names_the_file}.*{message}", load_recording, tmp_path)


def test_distortion_params_are_k1_k2_k3_k4_p1_p2(tmp_path: Path) -> None:
    plain = {key: value for key, value in LENS.items() if key[0] not in "kp"}
    params = [
        0.05,
        -0.02,
        0.01,
        0.0,
        0.003,
        -0.002,
    ]  # Nerfstudio's get_distortion_params
    write(tmp_path / "top", entries(ring(1)), **plain, distortion_params=params)
    write(tmp_path / "frame", entries(ring(1), distortion_params=params), **plain)
    write(tmp_path / "named", entries(ring(1)), **LENS, k3=0.01)
    top, frame, named = (first_camera(tmp_path / n) for n in ("top", "frame", "named"))
    assert top == frame == named


def test_bad_frames_are_left_out(tmp_path: Path) -> None:
    frames = entries(ring(4))
    frames[1]["is_bad"] = True
    frames[2]["is_bad"] = False
    write(tmp_path, frames, **LENS, test_filenames=["images/frame_00001.png"])
    recording = load_recording(tmp_path)
    assert [frame.name[-5] for frame in recording.train] == ["0", "2", "3"]
    assert (recording.test, recording.untracked) == ((), 1)
    assert recording.notes[0] == "1 frames are marked as bad and left out"


def test_blender_has_a_file_for_each_split(tmp_path: Path) -> None:
    for split, count in (("train", 3), ("val", 1), ("test", 2)):
        frames = entries(ring(count))
        for i, frame in enumerate(frames):
            frame["file_path"] = f"./{split}/r_{i}.5"  # without ending, with a dot
            black(tmp_path / split / f"r_{i}.5.png")
        file = tmp_path / f"transforms_{split}.json"
        file.write_text(json.dumps({"camera_angle_x": 0.6, "frames": frames}))
    recording = load_recording(tmp_path)
    assert (len(recording.train), len(recording.test)) == (3, 3)
    assert {frame.name.split("/")[1] for frame in recording.test} == {"val", "test"}
    alone = load_recording(tmp_path / "transforms_test.json")
    assert (len(alone.train), alone.test, alone.name) == (2, (), tmp_path.name)


@pytest.mark.parametrize("folder", ["undistorted_images", "resized_undistorted_images"])
def test_scannetpp_keeps_images_beside_the_folder_of_the_file(
    folder: str, tmp_path: Path
) -> None:
    frames = entries(ring(5))
    for i, frame in enumerate(frames):
        frame |= {"file_path": f"DSC{i}.JPG", "is_bad": i == 1}
        black(tmp_path / "dslr" / folder / frame["file_path"])
    data = {**LENS, "frames": frames[:3], "test_frames": frames[3:]}
    file = tmp_path / "dslr" / "nerfstudio" / "transforms_undistorted.json"
    file.parent.mkdir()
    file.write_text(json.dumps({**data, "camera_model": "PINHOLE"}))
    other = file.with_name("transforms.json")
    other.write_text(json.dumps({**data, "camera_model": "OPENCV_FISHEYE"}))
    for root in (tmp_path, file, file.parent):
        recording = load_recording(root)
        assert [frame.name for frame in recording.train] == ["DSC0.JPG", "DSC2.JPG"]
        assert [frame.name for frame in recording.test] == ["DSC3.JPG", "DSC4.JPG"]
        assert recording.untracked == 1
    refused("OPENCV_FISHEYE", load_recording, other)


@pytest.mark.parametrize("stored", [True, False])
def test_images_are_taken_as_stored_unless_only_upright_ones_fit(
    stored: bool, tmp_path: Path
) -> None:
    """nerfstudio ignores the EXIF orientation; other programs state the size of upright images."""
    upright = np.random.default_rng(0).integers(0, 255, (36, 24, 3), np.uint8)
    pixels = upright if stored else np.ascontiguousarray(np.rot90(upright))
    transforms = write(tmp_path, entries(ring(2)), **LENS)
    for file in (tmp_path / "images").iterdir():
        image = file.with_suffix(".jpg")
        write_image(image, pixels)
        image.write_bytes(with_orientation(image.read_bytes(), 6))
        file.unlink()
    transforms.write_text(transforms.read_text().replace(".png", ".jpg"))
    for frame in load_recording(tmp_path).train:
        assert frame.read_image().shape == (36, 24, 3)


def test_paths_of_windows_are_read(tmp_path: Path) -> None:
    file = write(tmp_path, entries(ring(2)), **LENS)
    file.write_text(file.read_text().replace("images/", "images\\\\"))
    for frame in load_recording(tmp_path).train:
        assert isinstance(frame.image, Path)
        assert frame.image.is_file()
