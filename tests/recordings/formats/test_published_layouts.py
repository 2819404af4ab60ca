"""7-Scenes and 12-Scenes as they are published, and what is usual after a download."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from benchmarks import layouts
from evercal.continual.benchmark.suites import load_suite
from evercal.geometry import Camera
from evercal.recordings import ReadOptions, load_recording
from evercal.recordings.samples import sample_rooms

from ..checks import assert_pose, refused


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene of each data set with two frames a sequence, and poses by SfM."""
    root = tmp_path_factory.mktemp("published")
    room = sample_rooms()[0].scene
    chess = layouts.FakedScene(room, layouts.SEVEN_CAMERA, 4)
    layouts.write_seven(root, "chess", chess, 2)
    kitchen = layouts.FakedScene(room, layouts.TWELVE_CAMERA, 0)
    layouts.write_twelve(root, "apt1/kitchen", kitchen, 4)
    return root


@pytest.fixture
def data(published: Path, tmp_path: Path) -> Path:
    """A copy that a test may change."""
    return Path(shutil.copytree(published, tmp_path / "data"))


def test_7_scenes_is_read_as_published(data: Path) -> None:
    recording = load_recording(data / "7scenes/chess")
    assert (len(recording.train), len(recording.test)) == (7, 4)
    assert recording.untracked == 1
    names = [frame.name for frame in recording.train[:3]]
    assert names == [
        "seq-01/frame-000000",
        "seq-02/frame-000000",
        "seq-02/frame-000001",
    ]
    assert recording.train[0].camera == layouts.SEVEN_CAMERA
    assert recording.train[0].read_image().shape == (480, 640, 3)


def test_12_scenes_is_read_as_published(data: Path) -> None:
    recording = load_recording(data / "12scenes/apt1/kitchen")
    assert (len(recording.train), len(recording.test)) == (3, 4)
    assert recording.untracked == 1
    camera = Camera(1296, 968, 1158.3, 1153.53, 649.0, 483.5)
    assert recording.test[0].camera == camera
    assert recording.test[0].read_image().shape == (968, 1296, 3)


def test_poses_of_the_colour_camera_are_those_of_the_images(data: Path) -> None:
    """The room of the images is known: its poses are those of its images, mirrored."""
    scene = layouts.FakedScene(sample_rooms()[0].scene, layouts.SEVEN_CAMERA, 4)
    truth = layouts.SE3.from_matrix(scene.pose(scene.room.train[0]))
    chess = data / "7scenes/chess"
    stated = load_recording(chess).train[0].base_from_camera
    assert stated is not None
    offset = np.linalg.norm(stated.translation_m - truth.translation_m)
    assert 0.0256 < offset < 0.0257
    options = ReadOptions(poses="colour")
    for recording in (
        load_recording(chess, options=options),
        *load_suite("i7s", data / "7scenes", ["chess"], "colour"),
        *load_suite("i7s", data / "7scenes", ["chess"], f"{data}/pgt/sfm/7scenes"),
    ):
        assert_pose(recording.train[0].base_from_camera, truth, 1e-6)
    kitchen = data / "12scenes/apt1/kitchen"
    refused("`poses` colour is for 7-Scenes", load_recording, kitchen, options=options)


def test_frames_without_an_original_pose_may_have_one_by_sfm(data: Path) -> None:
    poses = f"{data}/pgt/sfm/12scenes"
    (kitchen,) = load_suite("i12s", data / "12scenes", ["apt1/kitchen"], poses)
    names = [frame.name for frame in (*kitchen.test, *kitchen.train)]
    assert names == [f"frame-00000{i}" for i in (0, 1, 2, 4, 5, 6)]
    assert kitchen.untracked == 2
    original = load_recording(data / "12scenes/apt1/kitchen")
    assert original.train[0].name == "frame-000005"


def test_the_published_transform_is_that_of_published_poses() -> None:
    """Frame 0 of redkitchen/seq-01: as published, and as listed in pgt/dslam (ICCV 2021)."""
    original = layouts.SE3.from_matrix(
        [
            [0.9093129, 0.27262229, -0.31422433, -0.34045634],
            [-0.27248618, 0.9610498, 0.04527963, 0.01646982],
            [0.31433925, 0.04444965, 0.94820935, 0.29656917],
        ]
    )
    of_colour_camera = layouts.SE3.from_matrix(
        [
            [0.91253367, 0.27269505, -0.30482736, -0.31655767],
            [-0.27027569, 0.96143197, 0.05098645, 0.00936319],
            [0.30697452, 0.03586057, 0.95104188, 0.30249474],
        ]
    )
    converted = original @ layouts.COLOUR_FROM_DEPTH.inverse()
    assert_pose(converted, of_colour_camera, 1e-4)


def pack(folder: Path, archive: Path | None = None) -> None:
    """Replace a folder by a ZIP of it, beside it or elsewhere."""
    target = archive or folder
    shutil.make_archive(str(target), "zip", folder.parent, folder.name)
    shutil.rmtree(folder)


def test_archives_that_are_not_unpacked_are_named(data: Path) -> None:
    chess = data / "7scenes/chess"
    for number in (1, 2, 3, 4):
        pack(chess / f"seq-0{number}")
    message = (
        r"'sequence1' names seq-01, which is not in .*; not unpacked: seq-01\.zip,"
        rf" seq-02\.zip, seq-03\.zip and 1 more; unpack in {chess}$"
    )
    refused(message, load_recording, chess)
    shutil.unpack_archive(chess / "seq-01.zip", chess)
    refused(r"unpacked: seq-02\.zip, seq-03", load_recording, chess)
    for file in chess.glob("*Split.txt"):
        file.unlink()
    message = r"TrainSplit\.txt: split file is missing; .* not unpacked: seq-02"
    refused(message, load_recording, chess)
    shutil.rmtree(chess / "seq-01")
    shutil.rmtree(chess / "seq-05")
    shutil.rmtree(chess / "seq-06")
    message = r"chess: no known scene format, no images; .* not unpacked: seq-01\.zip, "
    refused(message, load_recording, chess)


def test_the_archive_of_a_scene_is_named(data: Path) -> None:
    seven = data / "7scenes"
    pack(seven / "chess")
    message = (
        rf"is missing; get it from .*; not unpacked: chess\.zip; unpack in {seven}$"
    )
    refused(message, load_suite, "i7s", seven, ["chess"])
    message = r"no such folder; .*; not unpacked: chess\.zip; unpack in"
    refused(message, load_recording, seven / "chess")
    message = r"a file, not a folder, .*; not unpacked: chess\.zip; unpack in"
    refused(message, load_recording, seven / "chess.zip")
    twelve = data / "12scenes"
    pack(twelve / "apt1")
    message = r"apt1/kitchen is missing; .*; not unpacked: apt1\.zip; unpack in"
    refused(message, load_suite, "i12s", twelve, ["apt1/kitchen"])
    # Archives of other things are not the reason.
    (seven / "chess.zip").rename(seven / "fire.zip")
    refused(r"other scenes with `scenes`$", load_suite, "i7s", seven, ["chess"])


def test_archives_beside_their_contents_are_no_reason(data: Path) -> None:
    (data / "7scenes/chess/seq-01.zip").touch()
    assert load_recording(data / "7scenes/chess").train
    (data / "7scenes/chess/seq-01/frame-000000.pose.txt").unlink()
    refused("check the path$", load_recording, data / "7scenes/chess")


def test_a_folder_one_level_off_is_told(data: Path) -> None:
    seven = data / "7scenes"
    for folder in (seven / "chess", data):
        message = rf"chess is missing; give `data` {seven}$"
        refused(message, load_suite, "i7s", folder, ["chess"])
    twelve = data / "12scenes"
    message = rf"kitchen is missing; give `data` {twelve}$"
    refused(message, load_suite, "i12s", twelve / "apt1", ["apt1/kitchen"])
    (seven / "chess").rename(seven / "inner")
    (seven / "chess").mkdir()
    (seven / "inner").rename(seven / "chess/chess")
    message = rf"give {seven}/chess/chess, or move what it holds to {seven}/chess$"
    refused(message, load_suite, "i7s", seven, ["chess"])


def test_12_scenes_in_parts_is_recognised(data: Path) -> None:
    kitchen = data / "12scenes/apt1/kitchen"
    pack(kitchen / "data")
    message = r"data: no images; .* not unpacked: data\.zip; unpack in"
    refused(message, load_recording, kitchen)
    shutil.unpack_archive(kitchen / "data.zip", kitchen)
    (kitchen / "info.txt").unlink()
    refused(r"info\.txt: calibration is missing", load_recording, kitchen)
