"""Lists of Cambridge Landmarks."""

from pathlib import Path

import numpy as np
import pytest

from evercal.geometry import SE3, Camera
from evercal.recordings import ReadOptions, load_recording, write_image

from ..checks import assert_pose, refused

NAMES = ["seq1/frame00001.png", "seq1/frame00002.png", "seq2/frame00001.png"]
POSES = SE3.exp(np.random.default_rng(3).normal(size=(3, 6)))
"""camera_from_base."""
FOCAL = [1670.5, 1671.5, 1672.5]


def line(name: str, pose: SE3) -> str:
    centre = pose.inverse().translation_m
    numbers = [*centre.tolist(), *pose.rotation_wxyz.tolist()]
    return " ".join([name, *map("{:.6f}".format, numbers)])


@pytest.fixture
def shop(tmp_path: Path) -> Path:
    """Two training images and a test image, 64x36."""
    root = tmp_path / "ShopFacade"
    for name in NAMES:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        write_image(root / name, np.zeros((36, 64, 3), np.uint8))
    header = (
        "Visual Landmark Dataset V1\nImageFile, Camera Position [X Y Z W P Q R]\n\n"
    )
    lines = [line(*row) for row in zip(NAMES, POSES, strict=True)]
    (root / "dataset_train.txt").write_text(header + "\n".join(lines[:2]) + "\n")
    (root / "dataset_test.txt").write_text(header + lines[2])
    rows = []
    for name, focal in zip(NAMES, FOCAL, strict=True):
        file = name.replace("png", "jpg")
        rows.append(f"{file}\t{focal} 1 0 0 0 0 0 0 -0.04 0")
    points = "1\n0 0 5 9 9 9 1 0 0 1.5 2.5"
    text = "\n".join(["NVM_V3 ", "", "3", *rows, "", points])
    (root / "reconstruction.nvm").write_text(text)
    return root


def test_lists_are_read_with_the_focal_lengths_of_the_reconstruction(
    shop: Path,
) -> None:
    recording = load_recording(shop)
    assert [frame.name for frame in recording.train] == NAMES[:2]
    assert [frame.name for frame in recording.test] == NAMES[2:]
    frames = [*recording.train, *recording.test]
    for frame, camera_from_base, focal in zip(frames, POSES, FOCAL, strict=True):
        assert_pose(frame.base_from_camera, camera_from_base.inverse(), 1e-5)
        assert frame.camera == Camera(64, 36, focal, focal, 31.5, 17.5)


def test_a_published_line_looks_at_the_shop(shop: Path) -> None:
    """ShopFacade, seq1/frame00001.png: the street runs along x, the shop lies at larger y."""
    text = "seq1/frame00001.png -0.157816 -10.413150 1.832074 0.712261 0.682691 -0.123193 0.106962"
    (shop / "dataset_test.txt").write_text(f"a\nb\n\n{text}")
    pose = load_recording(shop).test[0].base_from_camera
    assert pose is not None
    np.testing.assert_allclose(pose.translation_m, [-0.157816, -10.41315, 1.832074])
    right, down, forward = pose.rotation_matrix().T
    assert right[0] > 0.9
    assert down[2] < -0.9
    assert forward[1] > 0.9


def test_intrinsics_are_asked_for_if_they_are_not_stated(shop: Path) -> None:
    (shop / "reconstruction.nvm").unlink()
    refused("ShopFacade: states no intrinsics; give `camera`", load_recording, shop)
    camera = shop / "camera.txt"
    camera.write_text("60 0 31.5\n0 60 17.5\n0 0 1\n")
    recording = load_recording(shop, options=ReadOptions(camera=camera))
    assert {frame.camera.fx for frame in recording.train} == {60}


def test_impossible_positions_and_lost_images_are_untracked(shop: Path) -> None:
    """The first line is that of GreatCourt, seq5/frame00297.png."""
    file = shop / "dataset_train.txt"
    far = "3117382476.41 -137672612.29 -1240777531.79 0.308042 -0.508641 0.232939 0.769503"
    text = file.read_text().replace(line(NAMES[0], POSES[0]), f"{NAMES[0]} {far}")
    file.write_text(text)
    recording = load_recording(shop)
    assert [frame.name for frame in recording.train] == NAMES[1:2]
    assert recording.untracked == 1
    model = shop / "reconstruction.nvm"
    model.write_text(model.read_text().replace(f"{NAMES[2][:-4]}.jpg", "other.jpg"))
    assert load_recording(shop).untracked == 2


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("dataset_test.txt", None, r"dataset_test\.txt: list of images is missing"),
        (
            "dataset_test.txt",
            "a\nb\n\nx.png 1 2 3",
            "first line is not 'image X Y Z W P Q R'",
        ),
        (
            "dataset_test.txt",
            "a\nb\n\nx.png 1 2 3 4 5 6 nan",
            "row 1, column 'R': 'nan' is not",
        ),
        ("dataset_test.txt", "a\nb\n\nx.png 1 2 3 0 0 0 0", "a quaternion of length"),
        ("dataset_test.txt", "a\nb\n\n../x.png 1 2 3 1 0 0 0", "stays inside"),
        ("dataset_*.txt", "a\nb\n\n", "name no image"),
        ("reconstruction.nvm", "", r"reconstruction\.nvm: begins with NVM_V3"),
        ("reconstruction.nvm", "NVM_V3\n1\nx.jpg", r"reconstruction\.nvm: "),
        (
            "reconstruction.nvm",
            "NVM_V3\n1\nx.jpg -2 1",
            r"reconstruction\.nvm: camera fx",
        ),
    ],
)
def test_broken_files_are_refused(
    shop: Path, file: str, content: str | None, message: str
) -> None:
    for path in shop.glob(file):
        path.unlink() if content is None else path.write_text(content)
    refused(message, load_recording, shop)
