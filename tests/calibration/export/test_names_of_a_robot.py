"""Names of frames from a bag through scene, calibration and every ROS export, and back.

The arm is like one of Universal Robots: `base_link` with `base` turned by 180 degrees beside it.
"""

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yourdfpy

pytest.importorskip("rosbags", reason="the extra 'bags' is not installed")

from evercal.calibration.calibration import Calibration, read_calibration
from evercal.calibration.export.formats import FORMATS
from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance
from evercal.map import Map
from evercal.recordings import ReadOptions, Recording, load_recording
from evercal.recordings.samples import FOLDER
from evercal.robot.frame_names import UNKNOWN, FrameNames

from ...recordings.formats.bags_of_messages import Bag
from .test_one_pose import READERS

OPTICAL = "wrist_cam_color_optical_frame"
LINK = "wrist_cam_link"
NAMES = FrameNames("base_link", "tool0", OPTICAL)
TF = [name for name, row in FORMATS.items() if row.frame == "tf"]
HALF = np.pi / 2
Tree = dict[tuple[str, str], SE3]


def rpy(roll: float, pitch: float, yaw: float) -> SE3:
    """A rotation as a URDF states it."""
    x, y, z = (SE3.exp(np.r_[0, 0, 0, axis]) for axis in np.diag([roll, pitch, yaw]))
    return z @ y @ x


ARM: Tree = {
    ("base_link", "base"): rpy(0, 0, np.pi),
    ("wrist_3_link", "flange"): rpy(0, -HALF, -HALF),
    ("flange", "tool0"): rpy(HALF, 0, HALF),
}
"""What the description of the arm publishes, beside its joints."""
DRIVER: Tree = {
    (LINK, "wrist_cam_color_frame"): SE3.exp([0, 0.015, 0, 0, 0.002, 0.001]),
    ("wrist_cam_color_frame", OPTICAL): rpy(-HALF, 0, -HALF),
}
"""What the driver of the camera publishes."""


def root_from(tree: Tree, frame: str) -> SE3:
    pose = SE3.identity()
    above = {child: (parent, step) for (parent, child), step in tree.items()}
    assert len(above) == len(tree), "tf has one parent for each frame"
    while frame in above:
        frame, step = above[frame]
        pose = step @ pose
    assert frame in ("base_link", "wrist_3_link", LINK)
    return pose


def between(tree: Tree, a: str, b: str) -> SE3:
    """a_from_b."""
    return root_from(tree, a).inverse() @ root_from(tree, b)


def moved(base_from_tool0: SE3) -> Tree:
    """The arm, with tool0 at a pose in base_link."""
    step = base_from_tool0 @ between(ARM, "wrist_3_link", "tool0").inverse()
    return {**ARM, ("base_link", "wrist_3_link"): step}


def grippers(recording: Recording) -> list[SE3]:
    poses = [frame.base_from_gripper for frame in recording.train]
    return [pose for pose in poses if pose is not None]


def bag_of(recording: Recording, root: Path, static: Tree) -> tuple[Path, Path]:
    """A bag with tf of an arm that stands still at each image, and its camera file."""
    bag = Bag("mcap", optical=OPTICAL)
    for (parent, child), pose in {**ARM, **static}.items():
        bag.tf(0.0, parent, child, pose, static=True)
    for i, (frame, pose) in enumerate(
        zip(recording.train, grippers(recording), strict=True)
    ):
        step = moved(pose)["base_link", "wrist_3_link"]
        for at in (2 * i - 0.2, 2 * i + 0.2):
            bag.tf(at, "base_link", "wrist_3_link", step)
        bag.image(2.0 * i, "/cam/image_raw", frame.read_image())
    camera = root / "camera.json"
    root.mkdir(exist_ok=True)
    camera.write_text(json.dumps(recording.train[0].camera.to_dict()))
    return bag.write(root), camera


def in_a_urdf(tree: Tree, joint: str) -> SE3:
    """base_link_from_optical in a URDF of a tree, with another joint."""
    frames = {frame for pair in tree for frame in pair} | {OPTICAL}
    parts = [f'<link name="{frame}"/>' for frame in sorted(frames)]
    for (parent, child), step in tree.items():
        xyz = " ".join(map(repr, step.translation_m.tolist()))
        rpy = " ".join(map(repr, step.rotation.as_euler("xyz").tolist()))
        parts.append(
            f'<joint name="{parent}-{child}" type="fixed"><parent link="{parent}"/>'
            f'<child link="{child}"/><origin xyz="{xyz}" rpy="{rpy}"/></joint>'
        )
    robot = f'<robot name="r">{"".join(parts)}{joint}</robot>'
    model = yourdfpy.URDF.load(io.BytesIO(robot.encode()))
    return SE3.from_matrix(model.get_transform(OPTICAL, "base_link"))


@pytest.fixture(scope="module")
def hand() -> Recording:
    """Fourteen images of a camera on the gripper."""
    recording = load_recording(FOLDER / "bedroom" / "calibration" / "hand")
    frames = (*recording.train, *recording.test)
    return replace(recording, train=frames[:: len(frames) // 14][:14], test=())


@pytest.fixture(scope="module")
def named(hand: Recording, shared: Any, tmp_path_factory: Any) -> Path:
    """A map of the bag, and the calibrations of a wrist camera and of a fixed one."""

    def learn() -> Path:
        root = tmp_path_factory.mktemp("named")
        bag, camera = bag_of(hand, root, DRIVER)
        options = ReadOptions(camera, base_frame="base_link", gripper_frame="tool0")
        cell = Map.open(root / "cell.evercal")
        cell.learn(load_recording(bag, options=options), name="wrist")
        cell.calibration().write(root / "eye_in_hand.json")
        fixed = [hand.train[5].read_image()]
        cell.calibrate(fixed, frames=FrameNames(camera=OPTICAL)).write(
            root / "eye_to_hand.json"
        )
        return root

    return shared("named", learn)


@pytest.fixture(params=["eye_in_hand", "eye_to_hand"])
def calibration(named: Path, request: pytest.FixtureRequest) -> Calibration:
    return read_calibration(named / f"{request.param}.json")


def test_a_bag_names_the_frames_of_scene_and_calibrations(named: Path) -> None:
    cell = Map.open(named / "cell.evercal")
    cell.rename("wrist", "renamed")
    cell.rename("renamed", "wrist")
    (scene,) = Map.open(named / "cell.evercal").localizer.contents.scenes
    assert scene.frames == NAMES
    for mount, parent in (("eye_in_hand", "tool0"), ("eye_to_hand", "base_link")):
        own = read_calibration(named / f"{mount}.json")
        assert own.frames == NAMES
        assert (own.parent_frame, own.child_frame) == (parent, OPTICAL)


def test_the_camera_of_a_scene_does_not_name_another_one(
    named: Path, hand: Recording
) -> None:
    """Nor do gripper poses without names have the names of the scene's."""
    cell = Map.open(named / "cell.evercal")
    (image,) = [frame.read_image() for frame in hand.train[5:6]]
    assert cell.calibrate([image]).frames == FrameNames("base_link", "tool0")
    poses = SE3.stack(grippers(hand)[5:7])
    images = [frame.read_image() for frame in hand.train[5:7]]
    on_arm = cell.calibrate(images, robot_poses=poses, mount="eye_in_hand")
    assert on_arm.frames == FrameNames("base_link")
    turned = FrameNames("base", "tool0")
    with pytest.raises(
        InputError, match="`base_frame` base: scene wrist states base_l"
    ):
        cell.calibrate(images, robot_poses=poses, frames=turned)


@pytest.mark.filterwarnings("ignore:Gimbal lock")
@pytest.mark.parametrize("base", ["base_link", "base"])
@pytest.mark.parametrize("via", [False, True])
@pytest.mark.parametrize("name", TF)
def test_a_static_transform_by_hand_is_the_calibration(
    name: str,
    via: bool,
    base: str,
    calibration: Calibration,
    hand: Recording,
    tmp_path: Path,
) -> None:
    """Every frame that is written is one of the robot's, and the camera is where it was."""
    pose = calibration.parent_from_child
    expected = pose
    if calibration.on_gripper:
        expected = grippers(hand)[3] @ pose
    elif base == "base":  # the same camera in the other base
        pose = between(ARM, "base", "base_link") @ pose
    own = replace(calibration, parent_from_child=pose, frames=replace(NAMES, base=base))
    options: dict[str, Any] = {"lens": "estimated"}
    tree = moved(grippers(hand)[3])
    if via:
        file = tmp_path / "tf_static.yaml"
        rows = []
        for (parent, child), step in DRIVER.items():
            w, *xyz = step.rotation_wxyz.tolist()
            row = {"header": {"frame_id": parent}, "child_frame_id": child}
            rotation = dict(zip("xyzw", [*xyz, w], strict=True))
            translation = dict(zip("xyz", step.translation_m.tolist(), strict=True))
            row["transform"] = {"rotation": rotation, "translation": translation}
            rows.append(row)
        file.write_text(json.dumps({"transforms": rows}))
        options |= {"via": LINK, "via_transform": file}
        tree |= DRIVER
    text = own.export(name, **options)
    matrix, parent, child = READERS[name](text)
    tree[parent, child] = SE3.from_matrix(matrix)
    assert (parent, child) == (own.parent_frame, LINK if via else OPTICAL)
    assert max(pose_distance(between(tree, "base_link", OPTICAL), expected)) < 1e-7
    written = {frame for pair in tree for frame in pair}
    for role in ("robot_base_frame", "robot_effector_frame"):
        for line in text.splitlines():
            key, _, value = line.strip().partition(": ")
            assert key != role or value in written
    if name == "urdf":
        del tree[parent, child]
        assert max(pose_distance(in_a_urdf(tree, text), expected)) < 1e-6


@pytest.mark.parametrize("name", TF)
def test_a_bag_with_the_export_has_the_camera_where_it_was(
    name: str, named: Path, hand: Recording, tmp_path: Path
) -> None:
    own = read_calibration(named / "eye_in_hand.json")
    offset = {"via": LINK, "via_optical": True, "lens": "estimated"}
    matrix, parent, child = READERS[name](own.export(name, **offset))
    driver = {(LINK, OPTICAL): rpy(-HALF, 0, -HALF)}
    static = {(parent, child): SE3.from_matrix(matrix), **driver}
    few = replace(hand, train=hand.train[:3])
    bag, camera = bag_of(few, tmp_path, static)
    options = ReadOptions(camera, base_frame="base_link", gripper_frame=OPTICAL)
    read = load_recording(bag, options=options)
    assert read.frames == FrameNames("base_link", "", OPTICAL)
    for frame, gripper in zip(read.train, grippers(few), strict=True):
        assert frame.base_from_camera is not None
        expected = gripper @ own.parent_from_child
        assert max(pose_distance(frame.base_from_camera, expected)) < 1e-6


def test_a_name_that_is_unknown_is_asked_for(calibration: Calibration) -> None:
    unnamed = replace(calibration, frames=UNKNOWN)
    base = "the base frame is unknown: give `{}` (of Universal Robots, base for"
    gripper = "the gripper frame is unknown: give `{}`, such as tool0"
    parent = gripper if calibration.on_gripper else base
    other = base if calibration.on_gripper else gripper
    child = "the camera's frame is unknown: give `child`, such as"
    for name in TF:
        given = {}
        for option, words in (
            ("parent", parent),
            ("child", child),
            ("robot_frame", other),
        ):
            expected = option != "robot_frame" or name.startswith("easy")
            if expected:
                with pytest.raises(InputError, match="unknown") as caught:
                    unnamed.export(name, **given)
                assert words.format(option) in str(caught.value)
                assert "\n" not in str(caught.value)
            given[option] = f"my_{option}"
        assert READERS[name](unnamed.export(name, **given))[1:] == (
            "my_parent",
            "my_child",
        )
    for name in READERS.keys() - {*TF}:
        unnamed.export(name)
