"""LeRobot datasets in the layouts of versions 2.1 and 3.0, videos and embedded images.

The files are as the package lerobot 0.4 (version 3) and 0.3 (version 2) writes them.
"""

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from evercal.errors import InputError
from evercal.geometry import SE3, Camera
from evercal.recordings import ReadOptions, generic, load_recording, write_image
from evercal.robot.frame_names import FrameNames

from ..checks import assert_pose, refused

av: Any = pytest.importorskip("av", reason="the extra 'lerobot' is not installed")
pa: Any = pytest.importorskip("pyarrow", reason="the extra 'lerobot' is not installed")
pq: Any = pytest.importorskip("pyarrow.parquet")

WRIST = "observation.images.wrist"
FRONT = "observation.images.front"
EPISODES = 3
LENGTH = 7
FPS = 10
PARTS = ["x", "y", "z", "qx", "qy", "qz", "qw"]
URDF = """<robot name="planar"><link name="base"/><link name="upper"/><link name="tip"/>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="reach" type="prismatic"><parent link="upper"/><child link="tip"/>
    <origin xyz="0.5 0 0"/><axis xyz="1 0 0"/></joint></robot>"""


def picture(episode: int, number: int) -> np.ndarray:
    image = np.zeros((64, 96, 3), np.uint8)
    image[:] = (200, 60, 20 + 10 * number + 70 * episode)
    image[32:, 48:] = (20, 220, 60)
    return image


def pose(episode: int, number: int) -> SE3:
    half = 0.05 * number
    return SE3(
        np.array([np.cos(half), 0, 0, np.sin(half)]),
        np.array([0.1 * number, episode, 0.5]),
    )


def joints(episode: int, number: int) -> list[float]:
    return [0.1 * number + 0.3 * episode, 0.05 * number]


def write_video(path: Path, images: list[np.ndarray], codec: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=FPS, options={"crf": "10"})
        stream.width = 96
        stream.height = 64
        stream.pix_fmt = "yuv420p"
        for image in images:
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def write_rows(path: Path, episodes: range, images: bool) -> None:
    rows = [(e, n) for e in episodes for n in range(LENGTH)]
    poses = SE3.stack([pose(e, n) for e, n in rows])
    ee = np.hstack([poses.translation_m, np.roll(poses.rotation_wxyz, -1, axis=1)])
    columns: dict[str, Any] = {
        "observation.state": pa.array([joints(e, n) for e, n in rows]),
        "observation.ee": pa.array(ee.astype(np.float32).tolist()),
        "timestamp": pa.array([n / FPS for _, n in rows], pa.float32()),
        "frame_index": pa.array([n for _, n in rows]),
        "episode_index": pa.array([e for e, _ in rows]),
    }
    if images:
        for key in (WRIST, FRONT):
            cells = []
            for e, n in rows:
                image = picture(e, n) if key == WRIST else 255 - picture(e, n)
                data = cv2.imencode(".png", image[:, :, ::-1])[1].tobytes()
                cells.append({"bytes": data, "path": f"frame-{n:06d}.png"})
            columns[key] = pa.array(cells)
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table(columns), path, row_group_size=5)


def write_episodes(file: Path) -> None:
    """Where each episode begins in the videos of version 3."""
    prefix = f"videos/{WRIST}"
    episodes = [
        {
            "episode_index": e,
            f"{prefix}/chunk_index": 0,
            f"{prefix}/file_index": e // 2,
            f"{prefix}/from_timestamp": (e % 2) * LENGTH / FPS,
        }
        for e in range(EPISODES)
    ]
    file.parent.mkdir(parents=True)
    pq.write_table(pa.Table.from_pylist(episodes), file)


def make(root: Path, version: str, kind: str = "video", codec: str = "libx264") -> Path:
    """A dataset of three episodes of seven frames with two cameras."""
    image = {
        "dtype": kind,
        "shape": [64, 96, 3],
        "names": ["height", "width", "channels"],
    }
    features: dict[str, Any] = {
        "observation.state": {
            "dtype": "float32",
            "names": ["shoulder.pos", "reach.pos"],
        },
        "observation.ee": {"dtype": "float32", "names": PARTS},
        WRIST: image,
        FRONT: image,
        "timestamp": {"dtype": "float32", "names": None},
    }
    info: dict[str, Any] = {
        "codebase_version": version, "fps": FPS, "chunks_size": 2, "total_episodes": EPISODES,
        "features": features,
    }  # fmt: skip
    old = version == "v2.1"
    if old:
        info["video_path"] = (
            "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
        )
        parts = [
            (range(e, e + 1), f"chunk-{e // 2:03d}", f"episode_{e:06d}")
            for e in range(EPISODES)
        ]
    else:  # two episodes in the first file, one in the second
        info["video_path"] = (
            "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
        )
        parts = [
            (range(2), "chunk-000", "file-000"),
            (range(2, 3), "chunk-000", "file-001"),
        ]
        write_episodes(root / "meta/episodes/chunk-000/file-000.parquet")
    for episodes, chunk, name in parts:
        write_rows(root / "data" / chunk / f"{name}.parquet", episodes, kind == "image")
        if kind == "video":
            shown = [picture(e, n) for e in episodes for n in range(LENGTH)]
            folder = f"{chunk}/{WRIST}" if old else f"{WRIST}/{chunk}"
            write_video(root / "videos" / folder / f"{name}.mp4", shown, codec)
    (root / "meta").mkdir(exist_ok=True)
    (root / "meta/info.json").write_text(json.dumps(info))
    (root / "lens.txt").write_text("80 0 47.5\n0 80 31.5\n0 0 1\n")
    return root


def options(root: Path, **more: Any) -> ReadOptions:
    return ReadOptions(camera=root / "lens.txt", **{"image_topic": WRIST, **more})


def refuses(message: str, root: Path, **more: Any) -> None:
    refused(message, load_recording, root, options=options(root, **more))


@pytest.mark.parametrize(
    ("version", "kind", "codec"),
    [
        ("v2.1", "video", "libx264"),
        ("v2.1", "image", ""),
        ("v3.0", "video", "libx264"),
        ("v3.0", "video", "libsvtav1"),
        ("v3.0", "image", ""),
    ],
)
def test_datasets_are_read(version: str, kind: str, codec: str, tmp_path: Path) -> None:
    root = make(tmp_path / "wave", version, kind, codec)
    recording = load_recording(root, options=options(root))
    assert recording.name == "wave"
    names = [frame.name for frame in recording.train[6:8]]
    assert names == ["episode_000000/000006", "episode_000001/000000"]
    with ThreadPoolExecutor(3) as pool:  # in any order
        images = list(pool.map(lambda frame: frame.read_image(), recording.train[::-1]))
    for i, (frame, image) in enumerate(zip(recording.train, images[::-1], strict=True)):
        at = divmod(i, LENGTH)
        assert frame.camera == Camera(96, 64, 80, 80, 47.5, 31.5)
        off = np.abs(image[8:24, 8:40].mean((0, 1)) - picture(*at)[16, 16])
        assert off.max() < (5 if kind == "video" else 1e-9)  # frames differ by 10
        assert_pose(frame.base_from_gripper, pose(*at), 1e-6)
    assert recording.notes[0].startswith("gripper poses are observation.ee: ")


def test_joints_and_a_urdf_in_radians_or_degrees(tmp_path: Path) -> None:
    root = make(tmp_path / "wave", "v2.1", "image")
    urdf = root / "arm.urdf"
    urdf.write_text(URDF)
    for convention, unit in ((None, 1.0), ("rad", 1.0), ("deg", np.pi / 180)):
        read = options(root, urdf=urdf, pose_convention=convention, every=4)
        recording = load_recording(root, options=read)
        assert len(recording.train) == 6
        for i, frame in enumerate(recording.train):
            shoulder, reach = joints(*divmod(4 * i, LENGTH))
            turn = SE3.exp([0, 0, 0, 0, 0, shoulder * unit])
            expected = turn @ SE3.exp([0.5 + reach, 0, 0, 0, 0, 0])
            assert_pose(frame.base_from_gripper, expected, 1e-6)
    whole = load_recording(root, options=options(root, urdf=urdf, whole_robot=True))
    assert whole.arm
    assert whole.arm.joints == ("shoulder", "reach")
    assert whole.train[5].joints_rad == pytest.approx(joints(0, 5))
    message = "grad: joint angles are rad or deg"
    refuses(message, root, urdf=urdf, pose_convention="grad")
    assert recording.frames == FrameNames("base", "tip")
    change_names(root, ["shoulder.pos", "shoulder"], "observation.state")
    refuses(r"state: 'shoulder' comes twice", root, urdf=urdf)
    change_names(root, {"left": ["shoulder"], "right": ["reach"]}, "observation.state")
    refuses(r"no values for joint shoulder.*left\.shoulder", root, urdf=urdf)


def test_poses_in_a_given_convention(tmp_path: Path) -> None:
    root = make(tmp_path / "wave", "v2.1", "image")
    change_names(root, None)
    read = options(root, pose_convention="xyzw", gripper_frame="observation.ee")
    for i, frame in enumerate(load_recording(root, options=read).train):
        assert_pose(frame.base_from_gripper, pose(*divmod(i, LENGTH)), 1e-6)
    for convention, feature, message in (
        ("xyzw", None, r"observation\.state: "),
        ("martian", "observation.ee", "martian"),
        (
            "xyzw",
            "observation.hand",
            r"no feature 'observation\.hand'; `gripper_frame` is one of",
        ),
    ):
        refuses(message, root, pose_convention=convention, gripper_frame=feature)


def test_one_of_two_arms_is_selected(tmp_path: Path) -> None:
    root = make(tmp_path / "wave", "v2.1", "image")
    sides = [f"{side}_ee.{part}" for side in ("left", "right") for part in PARTS]
    # A second pose behind the first, 5 m above it.
    for file in root.glob("data/*/*.parquet"):
        first = np.array(pq.read_table(file)["observation.ee"].to_pylist())
        second = first + 5 * (np.arange(7) == 2)
        replace_column(file, "observation.ee", np.hstack([first, second]).tolist())
    change_names(root, sides)
    for arm, height in (("left_ee", 0.5), ("right_ee", 5.5)):
        frame = load_recording(root, options=options(root, gripper_frame=arm)).train[0]
        assert frame.base_from_gripper is not None
        assert frame.base_from_gripper.translation_m[2] == pytest.approx(height)
    for names, message in (
        (
            sides,
            r"observation\.ee: holds several poses .*`gripper_frame` left_ee or right_ee",
        ),
        ({"left": PARTS, "right": PARTS}, "`gripper_frame` left or right"),
        (PARTS * 2, r"holds several poses .*; give names that tell them apart"),
        (PARTS, r"observation\.ee: has 14 numbers and 7 names"),
    ):
        change_names(root, names)
        refuses(message, root)
    read = options(root, pose_convention="xyzw", gripper_frame="observation.ee")
    notes = load_recording(root, options=read).notes
    assert "the first 7 of its 14 numbers were taken (x, y," in notes[1]


def replace_column(file: Path, name: str, values: list[Any]) -> None:
    table = pq.read_table(file)
    place = table.schema.get_field_index(name)
    pq.write_table(table.set_column(place, name, pa.array(values)), file)


def change_names(root: Path, names: Any, feature: str = "observation.ee") -> None:
    features = json.loads((root / "meta/info.json").read_text())["features"]
    features[feature]["names"] = names
    change(root, features=features)


def test_embedded_images_are_copied(tmp_path: Path) -> None:
    root = make(tmp_path / "wave", "v3.0", "image")
    recording = load_recording(root, options=options(root, every=5))
    generic.write(tmp_path / "out", recording)
    image = load_recording(tmp_path / "out").train[3].read_image()
    np.testing.assert_array_equal(image, picture(2, 1))


def change(root: Path, **values: Any) -> None:
    file = root / "meta/info.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **values}))


def test_missing_options_and_files_are_named(tmp_path: Path) -> None:
    root = make(tmp_path / "wave", "v2.1")
    for changed, message in (
        (
            {"image_topic": None},
            r"2 cameras; name one with `image_topic`: observation\.images\.w",
        ),
        ({"image_topic": "top"}, "no picture in 'top'"),
        ({"camera": None}, "hold no intrinsics; give them with `camera`"),
        ({"image_topic": FRONT}, "video is missing; download it too"),
    ):
        refused(
            message, load_recording, root, options=replace(options(root), **changed)
        )
    (root / "data/chunk-001/episode_000002.parquet").unlink()
    notes = load_recording(root, options=options(root)).notes
    assert notes[-1] == "2 of 3 episodes are in the folder"
    video = root / "videos/chunk-000" / WRIST / "episode_000000.mp4"
    video.write_bytes(video.read_bytes()[:200])
    refuses("video cannot be decoded", root)
    (root / "data/chunk-000/episode_000000.parquet").write_bytes(b"PAR1")
    refuses(r"episode_000000\.parquet: cannot be read", root)


def test_truncated_video_is_refused(tmp_path: Path) -> None:
    root = make(tmp_path / "wave", "v2.1")
    video = root / "videos/chunk-000" / WRIST / "episode_000000.mp4"
    write_video(video, [picture(0, n) for n in range(3)], "libx264")
    recording = load_recording(root, options=options(root))
    with pytest.raises(InputError, match=r"no frame at 0\.500 s; the video is cut off"):
        recording.train[5].read_image()
    # The others can still be read.
    assert recording.train[2].read_image().shape == (64, 96, 3)
    assert recording.train[9].read_image().shape == (64, 96, 3)


def test_other_versions_and_features_are_refused(tmp_path: Path) -> None:
    root = make(tmp_path / "wave", "v2.1", "image")
    change_names(root, ["x", "y", "z", "roll", "pitch", "yaw", "grip"])
    for changed, message in (
        ({}, r"no feature holds a pose .*observation.state: shoulder, reach"),
        ({"codebase_version": "v1.6"}, r"version v1\.6; this evercal reads v2 and v3"),
        ({"codebase_version": "v2.1", "fps": 0}, "does not describe the dataset"),
    ):
        change(root, **changed)
        refuses(message, root)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
@pytest.mark.parametrize(
    ("name", "path", "message"),
    [
        (
            "video_path",
            "../other/{video_key}.mp4",
            "'video_path' stays inside the folder",
        ),
        (
            "video_path",
            "/tmp/{video_key}.mp4",
            "'video_path' is a path relative to the folder",
        ),
        ("data_path", "../../data.parquet", "'data_path' stays inside the folder"),
        (
            "video_path",
            "{nothing}.mp4",
            "does not describe the dataset .KeyError: 'nothing'",
        ),
    ],
)
def test_paths_outside_the_dataset_are_refused(
    version: str, name: str, path: str, message: str, tmp_path: Path
) -> None:
    root = make(tmp_path / "wave", version)
    change(root, **{name: path})
    refuses(f"info.json: .*{message}", root)


@pytest.mark.parametrize("path", ["../secret.png", "/etc/secret.png"])
def test_image_paths_outside_the_dataset_are_refused(path: str, tmp_path: Path) -> None:
    root = make(tmp_path / "wave", "v2.1", "image")
    write_image(tmp_path / "secret.png", picture(0, 0))
    for file in root.glob("data/*/*.parquet"):
        count = len(pq.read_table(file))
        replace_column(file, WRIST, [{"bytes": None, "path": path}] * count)
    refuses(f"image '{path}': the path", root)


@pytest.mark.parametrize("key", ["is_depth_map", "video.is_depth_map"])
def test_depth_is_no_picture(key: str, tmp_path: Path) -> None:
    root = make(tmp_path, "v3.0")
    features = json.loads((root / "meta/info.json").read_text())["features"]
    features[WRIST]["info"] = {key: False}
    features[FRONT]["info"] = {key: True}
    change(root, features=features)
    (root / "data/chunk-000/._file-000.parquet").write_bytes(b"\0\5\x16\7")
    assert load_recording(root, options=options(root, image_topic=None)).train
    refuses(f"no picture in '{FRONT}'; .*{WRIST}$", root, image_topic=FRONT)
