"""Bags of ROS 1 and ROS 2 and MCAP files, written by rosbags and read back."""

import sqlite3
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from evercal.geometry import Camera
from evercal.recordings import ReadOptions, generic, load_recording
from evercal.recordings.formats.ros_bag import BagImage

pytest.importorskip("rosbags", reason="the extra 'bags' is not installed")

from ..checks import assert_pose, refused
from .bags_of_messages import (
    BASE_FROM_SHOULDER,
    KINDS,
    SHOTS,
    Bag,
    arm,
    picture,
    recorded_bag,
    refusal,
    refusal_of,
    shoulder_from_tool,
    single,
)

CAMERA = Camera(32, 24, 30.0, 30.0, 15.0, 11.0, (0.1, 0.0, 0.0, 0.0, 0.0))


@pytest.mark.parametrize("kind", KINDS)
def test_bags_are_read(kind: str, tmp_path: Path) -> None:
    path = recorded_bag(kind).write(tmp_path)
    paths = [path]
    if kind != "ros1":  # the file inside the folder is a recording too
        paths += [p for p in path.iterdir() if p.suffix != ".yaml"]
    for path_inside in paths:
        recording = load_recording(path_inside)
        assert recording.name == "wave"
        assert len(recording.train) == 6
        assert (recording.test, recording.untracked) == ((), 2)
        for i, frame in enumerate(recording.train):
            assert frame.camera == CAMERA
            np.testing.assert_array_equal(frame.read_image(), picture(i))
            assert frame.base_from_camera is None
            expected = BASE_FROM_SHOULDER @ shoulder_from_tool(SHOTS[i])
            assert_pose(frame.base_from_gripper, expected)
        lost, origin, camera = recording.notes
        assert lost.startswith("2 of 8 images were taken outside the recorded poses")
        assert origin == "poses of the gripper are those of tool0 in base_link, from tf"
        assert "tf also has the camera (camera_optical)" in camera


def test_old_ros2_bags_without_definitions_are_read(tmp_path: Path) -> None:
    path = recorded_bag("sqlite3").write(tmp_path)
    with sqlite3.connect(next(path.glob("*.db3"))) as database:
        database.execute("DROP TABLE message_definitions")
        database.execute("UPDATE schema SET schema_version = 3")
    database.close()
    image = load_recording(path).train[4].read_image()
    np.testing.assert_array_equal(image, picture(4))


def test_binned_images_have_smaller_intrinsics(tmp_path: Path) -> None:
    bag = single(focal=60.0, size=(64, 48), binning=2)
    [frame] = load_recording(bag.write(tmp_path)).train
    whole = Camera(64, 48, 60, 60, 15, 11, CAMERA.distortion)
    assert frame.camera == whole.resized(32, 24)


FORMS = ((".png", "png"), (".jpg", "rgb8; jpeg compressed bgr8"))
"""Endings of files, and formats of their messages."""


def encoded(rgb: np.ndarray, ending: str = ".png", *options: int) -> bytes:
    """An image file."""
    return cv2.imencode(ending, rgb[..., ::-1], options)[1].tobytes()


def compressed(files: Iterable[tuple[bytes, str]]) -> Bag:
    """An arm, a camera and image files with their formats."""
    bag = arm()
    for at, (data, form) in zip(SHOTS, files, strict=False):
        bag.compressed(at, "/cam/image_raw/compressed", data, form)
    return bag


def test_compressed_images_are_read_by_threads_and_copied(tmp_path: Path) -> None:
    files = []
    for i in range(len(SHOTS)):
        ending, form = FORMS[i % 2]
        files.append((encoded(picture(i), ending), form))
    bag = compressed(files)
    recording = load_recording(bag.write(tmp_path))
    with ThreadPoolExecutor(4) as pool:
        images = list(pool.map(lambda frame: frame.read_image(), recording.train * 3))
    for i, image in enumerate(images):
        # Where colours meet, a JPEG of that size is far off.
        off = np.abs(image.astype(int) - picture(i % 6).astype(int))
        assert np.median(off) <= 1 if i % 2 else off.max() == 0
    generic.write(tmp_path / "out", recording)
    for i, frame in enumerate(load_recording(tmp_path / "out").train):
        assert isinstance(frame.image, Path)
        assert frame.image.suffix == FORMS[i % 2][0]
        assert frame.image.read_bytes() == files[i][0]


@pytest.mark.parametrize("kind", KINDS)
def test_images_may_be_read_while_messages_are_iterated(
    kind: str, tmp_path: Path
) -> None:
    frames = load_recording(recorded_bag(kind).write(tmp_path)).train
    image = frames[0].image
    assert isinstance(image, BagImage)
    # A deadlock would be in a thread with a time limit.
    with ThreadPoolExecutor(1) as pool:
        for i, _ in enumerate(image.bag.messages(["/cam/image_raw"])):
            pixels = pool.submit(frames[i % 6].read_image).result(timeout=5)
            np.testing.assert_array_equal(pixels, picture(i % 6))


def bayer(pattern: str, rgb: tuple[int, int, int]) -> np.ndarray:
    """What a sensor with this filter sees of one colour."""
    tile = np.array([rgb["rgb".index(letter)] for letter in pattern], np.uint8)
    return np.tile(tile.reshape(2, 2), (12, 16))


COLOUR = (200, 120, 40)
FLAT = np.full((24, 32, 3), COLOUR, np.uint8)
FOUR = np.dstack([FLAT, FLAT[..., 0]])
ENCODINGS = {
    "rgb8": FLAT,
    "bgr8": FLAT[..., ::-1].copy(),
    "8UC3": FLAT[..., ::-1].copy(),
    "rgba8": FOUR,
    "bgra8": FOUR[..., [2, 1, 0, 3]].copy(),
    "rgb16": FLAT.astype(np.uint16) * 257,
    "bayer_rggb8": bayer("rggb", COLOUR),
    "bayer_bggr8": bayer("bggr", COLOUR),
    "bayer_gbrg8": bayer("gbrg", COLOUR),
    "bayer_grbg8": bayer("grbg", COLOUR),
    # U Y V Y and Y U Y V, two pixels at a time; the standard scales luma to 16..235.
    "yuv422": np.tile(np.array([[94, 124], [178, 124]], np.uint8), (24, 16, 1)),
    "yuv422_yuy2": np.tile(np.array([[124, 94], [124, 178]], np.uint8), (24, 16, 1)),
}


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_encodings_are_decoded(encoding: str, tmp_path: Path) -> None:
    bag = single(ENCODINGS[encoding], encoding)
    image = load_recording(bag.write(tmp_path)).train[0].read_image()
    expected = np.array(COLOUR)
    if encoding.startswith("yuv"):
        # BT.601: R = 1.164 (Y - 16) + 1.596 (V - 128), and so on.
        y = 1.164 * (124 - 16)
        u = 94 - 128
        v = 178 - 128
        expected = np.round([y + 1.596 * v, y - 0.813 * v - 0.391 * u, y + 2.018 * u])
    assert np.abs(image.astype(int) - expected).max() <= 2


def test_grey_images_of_8_and_16_bits_are_decoded(tmp_path: Path) -> None:
    ramp = np.arange(24 * 32, dtype=np.uint8).reshape(24, 32)
    for encoding, pixels in (("mono8", ramp), ("mono16", ramp.astype(np.uint16) * 257)):
        bag = single(pixels, encoding)
        image = load_recording(bag.write(tmp_path / encoding)).train[0].read_image()
        np.testing.assert_array_equal(image, np.repeat(ramp[:, :, None], 3, axis=2))


def test_rectified_images_use_the_projection_matrix(tmp_path: Path) -> None:
    bag = single(topic="/cam/image_rect_color", kind="ros1")
    [frame] = load_recording(bag.write(tmp_path)).train
    assert frame.camera == Camera(32, 24, 28, 28, 16, 12)


def test_images_without_stamps_use_the_time_of_recording(tmp_path: Path) -> None:
    recording = load_recording(single(stamped=False).write(tmp_path))
    # Messages are recorded 5 ms after their stamps.
    expected = BASE_FROM_SHOULDER @ shoulder_from_tool(0.505)
    assert_pose(recording.train[0].base_from_gripper, expected, 1e-6)
    assert "carry no stamps" in recording.notes[0]


@pytest.fixture
def camera_file(tmp_path: Path) -> Path:
    (tmp_path / "camera.txt").write_text("31 0 15\n0 31 11\n0 0 1\n")
    return tmp_path / "camera.txt"


def test_missing_topics_are_named(tmp_path: Path, camera_file: Path) -> None:
    whole = recorded_bag().messages
    for topic, message in (
        (
            "/cam/image",
            "holds /cam/camera_info (sensor_msgs/CameraInfo), /tf (tf2_msgs/TF",
        ),
        (
            "/tf",
            "no tf in it, so there are no gripper poses; record /tf and /tf_static",
        ),
        (
            "/cam/camera_info",
            "no camera_info for /cam/image_raw (/cam/camera_info is expe",
        ),
    ):
        messages = [entry for entry in whole if not entry[0].startswith(topic)]
        root = tmp_path / topic.replace("/", "-")
        assert message in refusal(Bag("mcap", messages), root)
    recording = load_recording(root / "wave", options=ReadOptions(camera=camera_file))
    assert recording.train[0].camera == Camera(32, 24, 31, 31, 15, 11)


def test_several_image_topics_need_a_choice(tmp_path: Path, camera_file: Path) -> None:
    bag = recorded_bag("sqlite3")
    bag.image(0.4, "/left/image_raw", picture(9))
    bag.image(0.4, "/depth/image_raw", np.ones((24, 32), np.uint16), "16UC1")
    path = bag.write(tmp_path / "a")
    left = "/left/image_raw"
    for topic, message in (
        # The depth image is no candidate.
        (
            None,
            "images on 2 topics; give `image_topic`: /cam/image_raw, /left/image_raw",
        ),
        # The only camera_info is that of the other camera.
        (
            left,
            "no camera_info for /left/image_raw (/left/camera_info is expected, there is /cam/",
        ),
        ("/no", "no images on topic '/no'; images are on /cam/image_raw"),
    ):
        assert message in refusal_of(path, image_topic=topic)
    options = ReadOptions(image_topic=left, camera=camera_file)
    recording = load_recording(path, options=options)
    np.testing.assert_array_equal(recording.train[0].read_image(), picture(9))
    colour = ("/cam/image_raw", left)
    bag.messages = [entry for entry in bag.messages if entry[0] not in colour]
    message = "no pictures (/depth/image_raw: encoding '16UC1' holds depth"
    assert message in refusal(bag, tmp_path / "b")


@pytest.mark.parametrize(
    ("made", "message"),
    [
        ({"focal": 0.0}, "K is all zeros: the camera is not calibrated; give `camera`"),
        ({"model": "fov"}, "a camera of model fov has omega"),
        ({"size": (64, 48)}, "is for images of 64x48, /cam/image_raw is 32x24"),
        (
            {"encoding": "nv21"},
            "encoding 'nv21' is not supported; use one of rgb8, bgr8",
        ),
    ],
)
def test_unusable_messages_are_refused(
    made: dict[str, Any], message: str, tmp_path: Path
) -> None:
    assert message in refusal(single(**made), tmp_path)


def test_damaged_bags_are_refused(tmp_path: Path) -> None:
    path = recorded_bag("ros1").write(tmp_path)
    other = next(recorded_bag().write(tmp_path / "mcap").glob("*.mcap"))
    for file, way in (
        (path, "rosbag reindex"),
        (other, "mcap recover FILE -o NEW.mcap"),
    ):
        whole = file.read_bytes()
        file.write_bytes(whole[: len(whole) // 2])
        refused(f"rosbags cannot read it .*{way}", load_recording, file)


@pytest.mark.parametrize("kind", ["jpeg", "png"])
def test_a_mosaic_in_a_compressed_image_becomes_a_picture(
    kind: str, tmp_path: Path
) -> None:
    """The publisher of ROS 1 leaves it in both, that of ROS 2 in PNG only."""
    form = f"bayer_rggb8; {kind} compressed "
    options = [cv2.IMWRITE_JPEG_QUALITY, 100] if kind == "jpeg" else []
    mosaic = cv2.imencode(f".{kind}", bayer("rggb", COLOUR), options)[1].tobytes()
    files = [(mosaic, form), (encoded(FLAT), form), (encoded(FLAT), f"{form}bgr8")]
    frames = load_recording(compressed(files).write(tmp_path)).train
    images = [frame.read_image() for frame in frames]
    assert np.abs(images[0][4:-4, 4:-4].astype(int) - COLOUR).max() < 8
    for image in images[1:]:
        np.testing.assert_array_equal(image[0, 0], COLOUR)


def test_depth_in_a_compressed_image_is_no_picture(tmp_path: Path) -> None:
    data = cv2.imencode(".png", np.ones((24, 32), np.uint16))[1].tobytes()
    bag = compressed([(data, "16UC1; png compressed ")])
    assert "encoding '16UC1' holds depth" in refusal(bag, tmp_path)


def test_a_message_without_an_image_is_left_out(tmp_path: Path) -> None:
    data = encoded(picture(0))
    files = [(data, "png")] * len(SHOTS)
    files[0] = (data[: len(data) // 2], "png")
    read = load_recording(compressed(files).write(tmp_path))
    assert len(read.train) == 5  # of six with a pose
    note = "1 of 8 images are missing or unreadable and left out: message 0"
    assert note in read.notes
