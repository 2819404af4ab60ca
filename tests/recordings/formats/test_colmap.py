"""COLMAP models written by pycolmap: projections agree with pycolmap."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evercal.geometry import SE3
from evercal.recordings import load_recording, write_image
from evercal.recordings.formats import generic

from ..checks import assert_pose, refused, with_orientation

pycolmap: Any = pytest.importorskip(
    "pycolmap", reason="the extra 'colmap' is not installed"
)

MODELS = {
    "SIMPLE_PINHOLE": [50, 31, 25],
    "PINHOLE": [50, 52, 31, 25],
    "SIMPLE_RADIAL": [50, 31, 25, -0.1],
    "RADIAL": [50, 31, 25, -0.1, 0.02],
    "OPENCV": [50, 52, 31, 25, -0.1, 0.02, 0.003, -0.002],
    "FULL_OPENCV": [
        50,
        52,
        31,
        25,
        -0.1,
        0.02,
        0.003,
        -0.002,
        0.01,
        0.05,
        -0.02,
        0.004,
    ],
    "SIMPLE_FISHEYE": [40, 31, 25],
    "FISHEYE": [40, 42, 31, 25],
    "SIMPLE_RADIAL_FISHEYE": [40, 31, 25, 0.05],
    "RADIAL_FISHEYE": [40, 31, 25, 0.05, -0.01],
    "OPENCV_FISHEYE": [40, 42, 31, 25, 0.05, -0.01, 0.002, -0.0005],
    "FOV": [40, 42, 31, 25, 0.9],
    "EUCM": [40, 42, 31, 25, 0.6, 1.1],
}
WIDTH = 64
HEIGHT = 48


def camera_from_world(i: int) -> SE3:
    return SE3.exp([0.1 * i, -0.05 * i, 2.0, 0.02 * i, -0.1 * i, 0.05])


def make(root: Path, model: str = "PINHOLE", kind: str = "bin", images: int = 4,
         folder: str = "sparse/0", params: list[float] | None = None) -> Any:  # fmt: skip
    """Write a model with two cameras, its images, and one image without a pose."""
    reconstruction = pycolmap.Reconstruction()
    for number in (1, 2):
        values = [float(v) for v in params or MODELS[model]]
        values[0] += number  # so that images are not mixed up
        camera = pycolmap.Camera(
            model=model, width=WIDTH, height=HEIGHT, params=values, camera_id=number
        )
        reconstruction.add_camera_with_trivial_rig(camera)
    (root / "images" / "sub").mkdir(parents=True, exist_ok=True)
    for i in range(images):
        name = f"sub/image-{i + 8}.png"  # 10 comes after 9
        image = pycolmap.Image(name=name, camera_id=1 + i % 2, image_id=i + 1)
        matrix = camera_from_world(i).matrix()[:3]
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(matrix))
        write_image(root / "images" / name, np.full((HEIGHT, WIDTH, 3), i, np.uint8))
    for point in np.random.default_rng(0).uniform(-0.5, 0.5, (30, 3)):
        reconstruction.add_point3D(point, pycolmap.Track())
    lost = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    write_image(root / "images" / "sub" / "lost.png", lost)
    target = root / folder
    target.mkdir(parents=True, exist_ok=True)
    if kind == "bin":
        reconstruction.write_binary(str(target))
    else:
        reconstruction.write_text(str(target))
    return reconstruction


@pytest.mark.parametrize("kind", ["bin", "txt"])
@pytest.mark.parametrize("model", MODELS)
def test_projections_agree_with_colmap(model: str, kind: str, tmp_path: Path) -> None:
    written = make(tmp_path, model, kind)
    recording = load_recording(tmp_path)
    names = [frame.name for frame in recording.train]
    assert names == [f"sub/image-{i}.png" for i in range(8, 12)]
    assert (recording.test, recording.untracked) == ((), 1)
    for i, frame in enumerate(recording.train):
        assert int(frame.read_image().mean()) == i
        camera_from_base = camera_from_world(i)
        assert_pose(frame.base_from_camera, camera_from_base.inverse(), 1e-7)
        theirs = written.find_image_with_name(frame.name)
        for point in written.points3D.values():
            expected = theirs.project_point(point.xyz)
            # COLMAP counts from the image's corner, this program from its first pixel's centre.
            ours = frame.camera.project(camera_from_base.apply(point.xyz)) + 0.5
            np.testing.assert_allclose(ours, expected, atol=1e-6)
    assert "are those of COLMAP" in recording.notes[0]


@pytest.mark.parametrize("folder", [".", "sparse", "sparse/0", "colmap/sparse/0"])
def test_model_in_any_usual_folder_is_read(folder: str, tmp_path: Path) -> None:
    make(tmp_path, folder=folder, kind="txt")
    assert len(load_recording(tmp_path).train) == 4
    # Pointing at the model itself, or at the folder of models, does as well.
    assert len(load_recording(tmp_path / folder).train) == 4
    assert len(load_recording(tmp_path / folder.removesuffix("/0")).train) == 4


def test_one_of_several_models_is_read(tmp_path: Path) -> None:
    make(tmp_path, images=4, folder="sparse/0")
    make(tmp_path, images=6, folder="sparse/1")
    # From before undistortion.
    make(tmp_path, "OPENCV", images=7, folder="distorted/sparse/0")
    recording = load_recording(tmp_path)
    assert len(recording.train) == 6
    assert recording.train[0].camera.distortion == ()
    note = "took model 1, the one with the most images (0: 4, 1: 6)"
    assert recording.notes[1] == note


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("THIN_PRISM_FISHEYE", [50, 50, 31, 25, *[0] * 8]),
        ("DIVISION", [50, 50, 31, 25, 0.1]),
    ],
)
def test_other_models_are_refused_by_name(
    model: str, params: list[float], tmp_path: Path
) -> None:
    make(tmp_path, model, params=params)
    refused(f"{model} is not supported.*image_undistorter", load_recording, tmp_path)


def test_broken_files_are_refused(tmp_path: Path) -> None:
    make(tmp_path)
    for name in ("images.bin", "cameras.bin"):
        file = tmp_path / "sparse/0" / name
        data = file.read_bytes()
        for damaged in (data[:50], data[:-1], data[:7], data + b"\0"):
            file.write_bytes(damaged)
            refused(f"{name}: ends early or holds more", load_recording, tmp_path)
        file.write_bytes(data)
    (tmp_path / "none/sparse/0").mkdir(parents=True)
    refused("no COLMAP model", load_recording, tmp_path / "none", format="colmap")


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("cameras", "1 PINHOLE 64 48 51", "1 PINHOLE 64 48", r"\['fx', .* got 3"),
        ("cameras", "1 PINHOLE 64 48 51", "1 PINHOLE", "cameras.txt: .* got 1"),
        ("cameras", "1 PINHOLE", "1 PINHALL", "PINHALL is not supported"),
        ("cameras", "1 PINHOLE 64", "3 PINHOLE 64", "camera 1 has no entry"),
        ("images", "sub/image-9.png", "", "images.txt: '2 .*' is not IMAGE_ID QW"),
        ("images", "image-9.png", "image-8.png", "image-8.png comes twice"),
        ("images", "8.png\n\n", "8.png\n", "no line of observations .* an empty line"),
        (
            "images",
            "sub/image-9.png",
            "shot 1 a.png\n4 1 0 0 0 0 0 0 1 shot 1 a.png",
            "no line of observations",
        ),
        ("images", " 2 1 sub/image-8.png", " nan 1 sub/image-8.png", "finite"),
    ],
)
def test_mistakes_in_text_are_named(
    file: str, old: str, new: str, message: str, tmp_path: Path
) -> None:
    make(tmp_path, kind="txt")
    path = tmp_path / f"sparse/0/{file}.txt"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    refused(message, load_recording, tmp_path)


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_models_are_read_without_pycolmap(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make(tmp_path, kind=kind)
    (tmp_path / f"sparse/0/points3D.{kind}").unlink()
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert len(load_recording(tmp_path).train) == 4


def test_names_of_images_stay_inside_the_folder(tmp_path: Path) -> None:
    make(tmp_path, kind="txt")
    file = tmp_path / "sparse" / "0" / "images.txt"
    file.write_text(file.read_text().replace("sub/image-8.png", "../elsewhere.png"))
    refused("the name of an image stays inside the folder", load_recording, tmp_path)


@pytest.mark.parametrize("value", [3, 6])
def test_the_orientation_is_ignored_as_by_colmap(value: int, tmp_path: Path) -> None:
    """Written by pycolmap, which reads the stored pixels."""
    make(tmp_path)
    pixels = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    pixels[:, : WIDTH // 2] = 200
    files = sorted((tmp_path / "images/sub").glob("image-*.png"))
    write_image(tmp_path / "a.jpg", pixels)
    turned = with_orientation((tmp_path / "a.jpg").read_bytes(), value)
    for file in files:
        file.write_bytes(turned)
    stored = pycolmap.Bitmap.read(str(files[-1]), as_rgb=True).to_array()
    recording = load_recording(tmp_path)
    image = recording.train[0].read_image()
    np.testing.assert_allclose(image.astype(int), stored, atol=3)
    generic.write(tmp_path / "copy", recording)
    [copied, *_] = load_recording(tmp_path / "copy").train
    np.testing.assert_array_equal(copied.read_image(), image)


def test_names_of_a_text_model_are_read_whole(tmp_path: Path) -> None:
    """pycolmap's writer keeps blanks, its reader cuts them."""
    written = make(tmp_path)
    for image in written.images.values():
        name = image.name.replace("sub/image", "sub/IMG (1)")
        (tmp_path / "images" / image.name).rename(tmp_path / "images" / name)
        image.name = name
    for file in (tmp_path / "sparse/0").iterdir():
        file.unlink()
    written.write_text(str(tmp_path / "sparse/0"))
    assert load_recording(tmp_path).train[0].name == "sub/IMG (1)-8.png"
