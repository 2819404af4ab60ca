"""What a Python caller gets wrong: each is one line that names the argument and what is allowed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import evercal
from evercal import SE3, Calibration, InputError, LocalizeOptions, Map, PosePairs
from evercal.calibration.image_source import Images
from evercal.mapping.scene_map import MapContents
from evercal.mapping.store import MapStore
from evercal.recordings import Recording, write_image

POSES = SE3.exp(np.random.default_rng(0).normal(size=(4, 6)))
IMAGE = np.zeros((24, 32, 3), np.uint8)
FIXED = Calibration("eye_to_hand", SE3.identity(), np.eye(6))


@pytest.fixture(scope="module")
def cell(hall_map: MapContents, tmp_path_factory: pytest.TempPathFactory) -> Map:
    """A map of the hall."""
    store = MapStore.create(tmp_path_factory.mktemp("cell") / "map")
    store.commit(hall_map.scenes[0], {"hand_eye": None})
    return Map.open(store.root)


WRONG: dict[str, tuple[Callable[[Map], object], str]] = {
    "a misspelt mount": (
        lambda cell: cell.calibrate(IMAGE, mount="wrist"),  # pyright: ignore[reportArgumentType]
        "mount 'wrist': give eye_to_hand or eye_in_hand",
    ),
    "a mount with hyphens": (
        lambda cell: cell.calibrate(
            [IMAGE] * 4,
            robot_poses=POSES,
            mount="eye-in-hand",  # pyright: ignore[reportArgumentType]
        ),
        "mount 'eye-in-hand': give eye_to_hand or eye_in_hand",
    ),
    "a mount of a calibration": (
        lambda _: Calibration("gripper", SE3.identity(), np.eye(6)),  # pyright: ignore[reportArgumentType]
        "mount 'gripper': give eye_to_hand or eye_in_hand",
    ),
    "a mount of pose pairs": (
        lambda _: evercal.solve(PosePairs(("a", "b", "c", "d"), POSES, POSES), "hand"),  # pyright: ignore[reportArgumentType]
        "mount 'hand': give eye_to_hand or eye_in_hand",
    ),
    "fewer poses than images to calibrate": (
        lambda cell: cell.calibrate([IMAGE] * 5, robot_poses=POSES),
        "5 images and 4 robot poses: give one pose for every image",
    ),
    "fewer images than poses to align": (
        lambda cell: cell.align("hall", [IMAGE] * 3, robot_poses=POSES),
        "3 images and 4 robot poses: give one pose for every image",
    ),
    "fewer poses than images to align": (
        lambda cell: cell.align("hall", [IMAGE] * 6, robot_poses=POSES),
        "6 images and 4 robot poses: give one pose for every image",
    ),
    "fewer poses than images to check": (
        lambda cell: cell.check([IMAGE] * 6, FIXED, robot_poses=POSES),
        "6 images and 4 robot poses: give one pose for every image",
    ),
    "fewer images than poses to check": (
        lambda cell: cell.check(IMAGE, FIXED, robot_poses=POSES),
        "1 images and 4 robot poses: give one pose for every image",
    ),
    "one pose for all images": (
        lambda cell: cell.calibrate([IMAGE] * 4, robot_poses=SE3.identity()),
        "`robot_poses`: give a file, or SE3.stack",
    ),
    "poses as matrices": (
        lambda cell: cell.calibrate([IMAGE] * 4, robot_poses=POSES.matrix()),  # pyright: ignore[reportArgumentType]
        "`robot_poses`: give a file, or SE3.stack",
    ),
    "a file of poses with arrays": (
        lambda cell: cell.calibrate([IMAGE], robot_poses="poses.csv"),
        "poses.csv: a file of robot poses is paired with image files",
    ),
    "no poses for a camera on the gripper": (
        lambda cell: cell.calibrate(IMAGE, mount="eye_in_hand"),
        "eye_in_hand needs the gripper's pose at every image: give `robot_poses`",
    ),
    "a number instead of images": (
        lambda cell: cell.calibrate(7),  # pyright: ignore[reportArgumentType]
        "images: int; give a folder, image files, or arrays",
    ),
    "files and arrays": (
        lambda cell: cell.calibrate(["a.png", IMAGE]),  # pyright: ignore[reportArgumentType]
        "images: files and arrays; give either of them",
    ),
    "no images": (lambda cell: cell.calibrate([]), "no image given"),
    "a missing folder": (
        lambda cell: cell.calibrate("nowhere"),
        "nowhere: image file is missing",
    ),
    "an image of floats": (
        lambda cell: cell.localize(IMAGE / 255.0),
        "image: array of shape",
    ),
    "an unknown scene": (
        lambda cell: cell.align("attic", [IMAGE] * 4, robot_poses=POSES),
        "scene 'attic': the map has only hall",
    ),
    "neither images nor points": (
        lambda cell: cell.align("hall", [IMAGE]),
        "give images with robot_poses, points with picks, or board_poses",
    ),
    "a camera on the gripper to check": (
        lambda cell: cell.check(
            IMAGE, Calibration("eye_in_hand", SE3.identity(), np.eye(6))
        ),
        "the reference is a camera on the gripper",
    ),
    "no workers": (
        lambda cell: cell.learn_many([], workers=0),
        "workers 0: give a number >= 1",
    ),
    "an option out of range": (
        lambda _: LocalizeOptions(keyframes=0),
        "LocalizeOptions.keyframes is 0",
    ),
    "a scene to remove": (
        lambda cell: cell.remove("attic"),
        "attic",
    ),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_what_a_caller_gets_wrong_is_one_clear_line(wrong: str, cell: Map) -> None:
    call, words = WRONG[wrong]
    with pytest.raises(InputError) as refused:
        call(cell)
    message = str(refused.value)
    assert words in message
    assert "\n" not in message
    assert "--" not in message  # an option of the command line
    assert cell.scenes == ("hall",)


@pytest.mark.parametrize("memory", ["0%", "120%", "ten", "-5MB", "0.1", ""])
def test_memory_that_cannot_be_used_is_refused(
    memory: str, hall: Recording, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=r"memory .*: give a share of the frames"):
        Map.open(tmp_path / "map").learn(hall, memory=memory)
    assert not (tmp_path / "map").exists()


def test_a_new_map_locates_nothing_and_refuses_what_it_cannot_learn(
    hall: Recording, tmp_path: Path
) -> None:
    opened = Map.open(tmp_path / "map")
    few = Recording("few", hall.train[:3], ())
    with pytest.raises(InputError, match="scene 'few': 3 training frames are too few"):
        opened.learn(few)
    with pytest.raises(InputError, match="missing"):
        opened.learn(tmp_path / "missing")
    with pytest.raises(InputError, match=r"map .*: no scene learned yet"):
        opened.localize(IMAGE)
    with pytest.raises(InputError, match="no scene learned yet"):
        opened.calibrate(IMAGE)


def test_a_pick_of_a_point_that_was_not_touched_is_named(
    cell: Map, hall: Recording
) -> None:
    image = hall.test[3].read_image()
    picks = [("a.png", image, {"q": np.array([3.0, 4.0])})]
    with pytest.raises(InputError, match=r"a\.png: the picks name q, .* it gives p"):
        cell.align("hall", points={"p": np.zeros(3)}, picks=picks)


def test_one_bad_name_does_not_stop_the_other_recordings(
    rooms: tuple[Recording, ...], tmp_path: Path
) -> None:
    hidden: Any = Recording(".hidden", rooms[0].train, ())
    good = Recording("good", rooms[1].train[:16], ())
    opened = Map(MapStore.create(tmp_path / "map", short_side=64))
    options = evercal.MapOptions(adjust=False)
    with pytest.raises(InputError, match=r"1 of 2 .*scene name '\.hidden'"):
        opened.learn_many([good, hidden], workers=1, options=options)
    assert opened.scenes == ("good",)


def test_objects_are_readable_in_a_notebook(cell: Map) -> None:
    assert repr(cell) == f"Map({str(cell.path)!r}, 1 scenes: hall)"
    assert "<th>hall</th>" in cell._repr_html_()
    assert repr(FIXED) == (
        "Calibration(eye_to_hand, base_from_camera, (0.0, 0.0, 0.0) mm, 1000.00 mm, 57.296 deg)"
    )
    escaped = Calibration("eye_to_hand", SE3.identity(), np.eye(6), verdict="<b>")
    assert "&lt;b&gt;" in escaped._repr_html_()
    pose = SE3.from_translation(np.array([1.0, 2.0, 3.0]))
    estimate = evercal.PoseEstimate("ok", "", "hall", pose, np.eye(6), 9, 0.5, 1.0)
    assert repr(estimate) == (
        "PoseEstimate(status ok, scene hall, position (1.0000, 2.0000, 3.0000) in base,"
        " standard deviation 1.00000, 57.296 deg, inliers 9)"
    )
    assert "<td>hall</td>" in estimate._repr_html_()
    failed = evercal.PoseEstimate.failed("too dark")
    assert "reason too dark" in repr(failed)


def test_images_of_one_camera_may_be_files_or_arrays(tmp_path: Path) -> None:
    assert Images.of(IMAGE).images[0][0] == "image 0"
    assert len(Images.of(np.stack([IMAGE] * 3)).images) == 3
    write_image(tmp_path / "a.png", IMAGE)
    assert Images.of(tmp_path).images == [(str(tmp_path / "a.png"), tmp_path / "a.png")]
