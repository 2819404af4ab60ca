"""One place in several scenes of a map: their bases, ambiguous images, named scenes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evercal import Map
from evercal.errors import InputError
from evercal.geometry import SE3, pose_distance
from evercal.localization.localizer import Localizer
from evercal.mapping.build import MapOptions
from evercal.mapping.scene_map import base_from_other_base
from evercal.mapping.store import MapStore, read_scene
from evercal.recordings.frame import Frame, Recording

QUICK = MapOptions(adjust=False)
MOVED = SE3.exp([0.05, 0, 0, 0, 0, 0.1])
"""Pose of the first base in the second one."""


@pytest.fixture(scope="module")
def arc(arcs: tuple[Recording, Recording]) -> Recording:
    """A small scene."""
    return arcs[0]


def small_map(root: Path) -> Map:
    """A new map that encodes images at 120 pixels."""
    return Map(MapStore.create(root, short_side=120))


def in_base(recording: Recording, name: str, base_from_old: SE3) -> Recording:
    """A recording under another name, in another base."""

    def moved(frame: Frame) -> Frame:
        assert frame.base_from_camera is not None
        return replace(frame, base_from_camera=base_from_old @ frame.base_from_camera)

    train = tuple(map(moved, recording.train))
    return replace(
        recording, name=name, train=train, test=tuple(map(moved, recording.test))
    )


@pytest.fixture(scope="module")
def two_bases(arc: Recording, tmp_path_factory: pytest.TempPathFactory) -> Map:
    """A scene, learned before and after its base was moved."""
    cell = small_map(tmp_path_factory.mktemp("two") / "map")
    assert not cell.learn(arc, options=QUICK).same_place
    report = cell.learn(in_base(arc, "moved", MOVED), options=QUICK)
    (other,) = report.same_place
    far = pose_distance(MOVED @ truth(arc.test[0]), truth(arc.test[0]))[0]
    assert other.scene == "one"
    assert not other.same_base
    assert other.mm == pytest.approx(1000 * far, abs=150)
    assert "this place is mapped as one" in report.warnings[-1]
    return cell


def truth(frame: Frame) -> SE3:
    assert frame.base_from_camera is not None
    return frame.base_from_camera


def test_images_are_ambiguous_between_bases(two_bases: Map, arc: Recording) -> None:
    for frame in arc.test[2::8]:
        estimate = two_bases.localize(frame.read_image(), frame.camera)
        assert estimate.status == "ambiguous"
        assert set(estimate.alternatives_in) == {"one", "moved"}
        assert "name the scene with `scene`" in estimate.reason
        poses = dict(zip(estimate.alternatives_in, estimate.alternatives, strict=True))
        assert pose_distance(poses["one"], truth(frame))[0] < 0.03
        assert pose_distance(poses["moved"], MOVED @ truth(frame))[0] < 0.03


def test_a_named_scene_answers(two_bases: Map, arc: Recording) -> None:
    frame = arc.test[3]
    for name, base in (("one", SE3.identity()), ("moved", MOVED)):
        estimate = two_bases.within(name).localize(frame.read_image(), frame.camera)
        assert (estimate.status, estimate.scene) == ("ok", name)
        assert estimate.base_from_camera is not None
        assert pose_distance(estimate.base_from_camera, base @ truth(frame))[0] < 0.03
    with pytest.raises(InputError, match="scene 'gone'"):
        two_bases.within("gone")


def test_a_calibration_needs_one_base_and_check_takes_its_own(
    two_bases: Map, arc: Recording
) -> None:
    images = [arc.test[3].read_image()] * 2
    camera = arc.test[3].camera
    with pytest.raises(InputError, match="map this place in two bases"):
        two_bases.calibrate(images, camera=camera)
    calibration = two_bases.within("moved").calibrate(images, camera=camera)
    expected = MOVED @ truth(arc.test[3])
    assert pose_distance(calibration.parent_from_child, expected)[0] < 0.03
    assert not two_bases.check(images, calibration).moved


def test_scenes_that_are_stored_keep_their_places(two_bases: Map) -> None:
    first, second = Map.open(two_bases.path).localizer.contents.scenes
    between = base_from_other_base(second, first)
    assert between is not None
    metres, radians = pose_distance(between, MOVED)
    assert metres < 0.03
    assert radians < 0.03


def test_a_scene_that_an_earlier_version_wrote_is_in_a_place_of_its_own(
    arc: Recording, tmp_path: Path
) -> None:
    cell = small_map(tmp_path / "map")
    cell.learn(arc, options=QUICK)
    (folder,) = (cell.path / "stages").iterdir()
    content = json.loads((folder / "scene.json").read_text())
    del content["places"]
    (folder / "scene.json").write_text(json.dumps(content))
    old = read_scene(folder)
    moved = replace(old, name="moved", places={old.digest: MOVED})
    between = base_from_other_base(moved, old)
    assert between is not None
    assert max(pose_distance(between, MOVED.inverse())) < 1e-9


@pytest.mark.parametrize("base", ["", "left"])
def test_scenes_in_one_base_give_one_answer(
    base: str, arc: Recording, tmp_path: Path
) -> None:
    cell = small_map(tmp_path / "map")
    cell.learn(arc, base=base, options=QUICK)
    report = cell.learn(replace(arc, name="again"), base=base, options=QUICK)
    (other,) = report.same_place
    assert other.same_base
    assert not report.warnings
    frame = arc.test[3]
    estimate = cell.localize(frame.read_image(), frame.camera)
    assert (estimate.status, estimate.base) == ("ok", base)


def test_a_base_that_was_moved_is_not_the_base_of_its_name(
    arc: Recording, tmp_path: Path
) -> None:
    cell = small_map(tmp_path / "map")
    cell.learn(arc, base="left", options=QUICK)
    with pytest.raises(InputError, match="from the poses of one in base 'left'"):
        cell.learn(in_base(arc, "moved", MOVED), base="left", options=QUICK)
    assert cell.scenes == ("one",)
    cell.learn(in_base(arc, "one", MOVED), base="left", replace="one", options=QUICK)
    frame = arc.test[3]
    pose = cell.localize(frame.read_image(), frame.camera).base_from_camera
    assert pose is not None
    assert pose_distance(pose, MOVED @ truth(frame))[0] < 0.03


def test_merged_maps_are_related(arc: Recording, tmp_path: Path) -> None:
    for name, base in (("one", SE3.identity()), ("two", MOVED)):
        small_map(tmp_path / name).learn(in_base(arc, name, base), options=QUICK)
    merged = Map.open(tmp_path / "merged")
    merged.merge(tmp_path / "one", tmp_path / "two")
    frame = arc.test[3]
    for opened in (merged, Map.open(tmp_path / "merged")):
        estimate = opened.localize(frame.read_image(), frame.camera)
        assert estimate.status == "ambiguous"


def test_other_rooms_are_no_rivals(
    two_bases: Map, arcs: tuple[Recording, Recording], tmp_path: Path
) -> None:
    cell = small_map(tmp_path / "map")
    for arc in arcs:
        assert not cell.learn(arc, options=QUICK).same_place
    first, second = cell.localizer.contents.scenes
    assert base_from_other_base(first, second) is None


def test_an_image_of_what_has_changed_excludes_the_older_scene(
    two_bases: Map, arc: Recording
) -> None:
    contents = two_bases.localizer.contents
    first, second = contents.scenes
    frames = first.keyframes
    # Patches of a scene of noise match nowhere.
    noise = np.random.default_rng(0)
    grey = [noise.integers(0, 255, frames.grey(i).shape) for i in range(len(frames))]
    images = [encoded(image.astype(np.uint8)) for image in grey]
    gone = replace(first, keyframes=replace(frames, images=images))
    localizer = Localizer(replace(contents, scenes=[gone, second]))
    frame = arc.test[3]
    estimate = localizer.localize(frame.read_image(), frame.camera)
    assert (estimate.status, estimate.scene) == ("ok", "moved")


def encoded(image: np.ndarray) -> bytes:
    """A PNG file."""
    import cv2

    return cv2.imencode(".png", image)[1].tobytes()
