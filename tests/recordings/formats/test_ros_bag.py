"""Bags of ROS 1 and ROS 2 and MCAP files, written by rosbags and read back."""

import sqlite3
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from evercal.geometry import Camera, pose_distance
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
            assert frame.base_from_gripper is not None
            expected = BASE_FROM_SHOULDER @ shoulder_from_tool(SHOTS[i])
            metres, radians = pose_distance(frame.base_from_gripper, expected)
            assert metres < 1e-9
            assert radians < 1e-7
        assert recording.notes[0].startswith(
            "2 of 8 images were taken outside the recorded poses"
        )
        assert (
            recording.notes[1]
            == "poses of the gripper are those of tool0 in base_link, from tf"
        )
        assert "tf also has the camera (camera_optical)" in recording.notes[2]


def test_old_ros2_bags_without_definitions_are_read(tmp_path: Path) -> None:
    path = recorded_bag("sqlite3").write(tmp_path)
    with sqlite3.connect(next(path.glob("*.db3"))) as database:
        database.execute("DROP TABLE message_definitions")
        database.execute("UPDATE schema SET schema_version = 3")
    database.close()
    np.testing.assert_array_equal(
        load_recording(path).train[4].read_image(), picture(4)
    )


def test_binned_images_have_smaller_intrinsics(tmp_path: Path) -> None:
    bag = arm(Bag("mcap"))
    bag.image(1.0, "/camera/image_raw", picture(0))
    bag.info("/camera/camera_info", focal=60.0, size=(64, 48), binning=2)
    [frame] = load_recording(bag.write(tmp_path)).train
    assert frame.camera == Camera(64, 48, 60, 60, 15, 11, CAMERA.distortion).resized(
        32, 24
    )


def test_every_second_image_is_taken(tmp_path: Path) -> None:
    path = recorded_bag("ros1").write(tmp_path)
    recording = load_recording(path, options=ReadOptions(every=2))
    assert [frame.name for frame in recording.train] == ["000000", "000002", "000004"]


def test_compressed_images_are_read_by_threads_and_copied(tmp_path: Path) -> None:
    bag = arm(Bag("mcap"))
    files = []
    for i, at in enumerate(SHOTS):
        ending = ".jpg" if i % 2 else ".png"
        data = cv2.imencode(ending, picture(i)[:, :, ::-1])[1].tobytes()
        what = "rgb8; jpeg compressed bgr8" if i % 2 else "png"
        bag.compressed(at, "/cam/image_raw/compressed", data, what)
        files.append((ending, data))
    bag.info("/cam/camera_info")
    recording = load_recording(bag.write(tmp_path))
    with ThreadPoolExecutor(4) as pool:
        images = list(pool.map(lambda frame: frame.read_image(), recording.train * 3))
    for i, image in enumerate(images):
        # Where colours meet, a JPEG of that size is far off.
        off = np.abs(image.astype(int) - picture(i % 6).astype(int))
        assert np.median(off) <= 1 if i % 2 else off.max() == 0
    generic.write(tmp_path / "out", recording)
    for (ending, data), frame in zip(
        files, load_recording(tmp_path / "out").train, strict=False
    ):
        assert isinstance(frame.image, Path)
        assert frame.image.suffix == ending
        assert frame.image.read_bytes() == data


@pytest.mark.parametrize("kind", KINDS)
def test_images_may_be_read_while_messages_are_iterated(
    kind: str, tmp_path: Path
) -> None:
    frames = load_recording(recorded_bag(kind).write(tmp_path)).train
    image = frames[0].image
    assert isinstance(image, BagImage)
    with ThreadPoolExecutor(
        1
    ) as pool:  # a deadlock would be in a thread with a time limit
        for i, _ in enumerate(image.bag.messages(["/cam/image_raw"])):
            pixels = pool.submit(frames[i % 6].read_image).result(timeout=5)
            np.testing.assert_array_equal(pixels, picture(i % 6))


def bayer(pattern: str, rgb: tuple[int, int, int]) -> np.ndarray:
    """What a sensor with this filter sees of one colour."""
    tile = np.array([rgb["rgb".index(letter)] for letter in pattern], np.uint8).reshape(
        2, 2
    )
    return np.tile(tile, (12, 16))


COLOUR = (200, 120, 40)
YUV = cv2.cvtColor(np.full((1, 1, 3), COLOUR, np.uint8), cv2.COLOR_RGB2YUV)[
    0, 0
].tolist()
ENCODINGS = {
    "rgb8": np.full((24, 32, 3), COLOUR, np.uint8),
    "bgr8": np.full((24, 32, 3), COLOUR[::-1], np.uint8),
    "8UC3": np.full((24, 32, 3), COLOUR[::-1], np.uint8),
    "rgba8": np.full((24, 32, 4), (*COLOUR, 7), np.uint8),
    "bgra8": np.full((24, 32, 4), (*COLOUR[::-1], 7), np.uint8),
    "rgb16": np.full((24, 32, 3), COLOUR, np.uint16) * np.uint16(257),
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
    expected = np.full((24, 32, 3), COLOUR)
    if encoding.startswith("yuv"):
        # BT.601: R = 1.164 (Y - 16) + 1.596 (V - 128), and so on.
        y = 1.164 * (124 - 16)
        u = 94 - 128
        v = 178 - 128
        expected[:] = np.round(
            [y + 1.596 * v, y - 0.813 * v - 0.391 * u, y + 2.018 * u]
        )
    assert np.abs(image.astype(int) - expected).max() <= 2


def test_grey_images_of_8_and_16_bits_are_decoded(tmp_path: Path) -> None:
    ramp = np.arange(24 * 32, dtype=np.uint8).reshape(24, 32)
    for encoding, pixels in (("mono8", ramp), ("mono16", ramp.astype(np.uint16) * 257)):
        bag = single(pixels, encoding)
        image = load_recording(bag.write(tmp_path / encoding)).train[0].read_image()
        np.testing.assert_array_equal(image, np.repeat(ramp[:, :, None], 3, axis=2))


def test_rectified_images_use_the_projection_matrix(tmp_path: Path) -> None:
    bag = single(topic="/cam/image_rect_color", kind="ros1")
    assert load_recording(bag.write(tmp_path)).train[0].camera == Camera(
        32, 24, 28, 28, 16, 12
    )


def test_images_without_stamps_use_the_time_of_recording(tmp_path: Path) -> None:
    recording = load_recording(single(stamped=False).write(tmp_path))
    # Messages are recorded 5 ms after their stamps.
    expected = BASE_FROM_SHOULDER @ shoulder_from_tool(0.505)
    assert_pose(recording.train[0].base_from_gripper, expected, 1e-6)
    assert "carry no stamps" in recording.notes[0]


def test_missing_topics_are_named(tmp_path: Path) -> None:
    whole = recorded_bag("mcap")
    parts = {}
    topics = {"images": "/cam/image_raw", "tf": "/tf", "info": "/cam/camera_info"}
    for missing, topic in topics.items():
        messages = [
            m
            for m in whole.messages
            if m[0] != topic and not m[0].startswith(f"{topic}_")
        ]
        parts[missing] = refusal(Bag("mcap", messages), tmp_path / missing)
    assert "no images in it" in parts["images"]
    assert (
        "holds /cam/camera_info (sensor_msgs/CameraInfo), /tf (tf2_msgs/TF"
        in parts["images"]
    )
    assert (
        "no tf in it, so there are no gripper poses; record /tf and /tf_static"
        in parts["tf"]
    )
    assert (
        "no camera_info for /cam/image_raw (/cam/camera_info is expected"
        in parts["info"]
    )
    camera_file = tmp_path / "camera.txt"
    camera_file.write_text("31 0 15\n0 31 11\n0 0 1\n")
    recording = load_recording(
        tmp_path / "info" / "wave", options=ReadOptions(camera=camera_file)
    )
    assert recording.train[0].camera == Camera(32, 24, 31, 31, 15, 11)


def test_several_image_topics_need_a_choice(tmp_path: Path) -> None:
    bag = recorded_bag("sqlite3")
    bag.image(0.4, "/left/image_raw", picture(9))
    bag.image(0.4, "/depth/image_raw", np.ones((24, 32), np.uint16), "16UC1")
    path = tmp_path / "a"
    # The depth image is no candidate.
    expected = "images on 2 topics; give `image_topic`: /cam/image_raw, /left/image_raw"
    assert expected in refusal(bag, path)
    # The only camera_info is that of the other camera.
    message = "no camera_info for /left/image_raw (/left/camera_info is expected, there is /cam/"
    assert message in refusal_of(path / "wave", image_topic="/left/image_raw")
    camera_file = tmp_path / "camera.txt"
    camera_file.write_text("31 0 15\n0 31 11\n0 0 1\n")
    options = ReadOptions(image_topic="/left/image_raw", camera=camera_file)
    recording = load_recording(path / "wave", options=options)
    np.testing.assert_array_equal(recording.train[0].read_image(), picture(9))
    message = "no images on topic '/no'; images are on /cam/image_raw"
    assert message in refusal_of(path / "wave", image_topic="/no")
    bag.messages = [
        m for m in bag.messages if m[0] not in ("/cam/image_raw", "/left/image_raw")
    ]
    message = refusal(bag, tmp_path / "b")
    assert "no pictures (/depth/image_raw: encoding '16UC1' holds depth" in message


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
    other = next(recorded_bag("mcap").write(tmp_path / "mcap").glob("*.mcap"))
    for file, way in (
        (path, "rosbag reindex"),
        (other, "mcap recover FILE -o NEW.mcap"),
    ):
        whole = file.read_bytes()
        file.write_bytes(whole[: len(whole) // 2])
        refused(f"rosbags cannot read it .*{way}", load_recording, file)


@pytest.mark.parametrize(
    "form", ["bayer_rggb8; jpeg compressed ", "bayer_rggb8; png compressed "]
)
def test_a_mosaic_in_a_compressed_image_becomes_a_picture(
    form: str, tmp_path: Path
) -> None:
    """The publisher of ROS 1 leaves it in both, that of ROS 2 in PNG only."""
    ending = ".jpg" if "jpeg" in form else ".png"
    options = [cv2.IMWRITE_JPEG_QUALITY, 100] if ending == ".jpg" else []
    data = cv2.imencode(ending, bayer("rggb", COLOUR), options)[1].tobytes()
    image = read_one_compressed(data, form, tmp_path)
    off = np.abs(image[4:-4, 4:-4].astype(int) - COLOUR)
    assert off.max() < 8
    converted = cv2.imencode(".png", np.full((24, 32, 3), COLOUR[::-1], np.uint8))[
        1
    ].tobytes()
    for stated in (form, f"{form}bgr8"):
        colour = read_one_compressed(converted, stated, tmp_path / stated[-5:])
        np.testing.assert_array_equal(colour[0, 0], COLOUR)


def read_one_compressed(data: bytes, form: str, root: Path) -> np.ndarray:
    bag = arm(Bag("mcap"))
    for at in SHOTS:
        bag.compressed(at, "/cam/image_raw/compressed", data, form)
    bag.info("/cam/camera_info")
    root.mkdir(parents=True, exist_ok=True)
    return load_recording(bag.write(root)).train[0].read_image()


def test_depth_in_a_compressed_image_is_no_picture(tmp_path: Path) -> None:
    data = cv2.imencode(".png", np.ones((24, 32), np.uint16))[1].tobytes()
    bag = arm(Bag("mcap"))
    bag.compressed(0.4, "/cam/image_raw/compressed", data, "16UC1; png compressed ")
    bag.info("/cam/camera_info")
    assert "encoding '16UC1' holds depth" in refusal(bag, tmp_path)


def test_a_message_without_an_image_is_left_out(tmp_path: Path) -> None:
    data = cv2.imencode(".png", picture(0))[1].tobytes()
    bag = arm(Bag("mcap"))
    for i, at in enumerate(SHOTS):
        part = len(data) // 2 if i == 0 else len(data)
        bag.compressed(at, "/cam/image_raw/compressed", data[:part], "png")
    bag.info("/cam/camera_info")
    read = load_recording(bag.write(tmp_path))
    assert len(read.train) == 5  # of six with a pose
    assert (
        "1 of 8 images are missing or unreadable and left out: message 0" in read.notes
    )
