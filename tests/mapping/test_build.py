"""`build_map` in a room whose surfaces are known in closed form."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from evercal.continual.finish_scene import mapped_record
from evercal.continual.networks.atlas import Cell
from evercal.errors import InputError
from evercal.features.encoder import load_encoder
from evercal.geometry.camera import Camera
from evercal.geometry.se3 import SE3, pose_distance
from evercal.mapping.build import (
    MapOptions,
    Mapping,
    SceneMap,
    _moved,
    build_map,
    map_steps,
    spread_frames,
)
from evercal.mapping.bundle_adjustment import Adjustment
from evercal.mapping.prepared_frames import WorkingSize
from evercal.mapping.scene_maps import SceneRecord
from evercal.recordings.frame import Frame, Recording
from evercal.simulation.box_room import BoxRoom

if TYPE_CHECKING:
    from evercal.continual.stage import Stage

SMALL = MapOptions(size=WorkingSize(cells=120, patches=120))


@pytest.fixture(scope="module")
def found(hall_stage: Stage) -> SceneMap:
    assert hall_stage.scene_map is not None
    return hall_stage.scene_map


def moved(frames: tuple[Frame, ...], change: SE3) -> tuple[Frame, ...]:
    """The frames with `change` multiplied to all poses on the right."""
    return tuple(
        replace(frame, base_from_camera=frame.base_from_camera @ change)
        for frame in frames
        if frame.base_from_camera is not None
    )


def test_landmarks_are_where_the_room_is(found: SceneMap) -> None:
    room, off, sure = BoxRoom(34, texture_px=256), [], []
    keyframes = found.keyframes
    for i, marks in enumerate(keyframes.landmarks):
        assert len(marks) > 100
        pose, camera = keyframes.base_from_camera[i], keyframes.cameras[i]
        rays = camera.unproject(marks.pixels)
        _, depth = room.intersect(pose.translation_m, rays @ pose.rotation_matrix().T)
        error = 1 / marks.inverse_depth / depth - 1
        off.append(np.abs(error))
        sure.append(np.abs(marks.inverse_depth - 1 / depth) / marks.sigma)
    every, claimed = np.concatenate(off), np.concatenate(sure)
    assert np.median(every) < 0.003
    assert np.quantile(every, 0.9) < 0.02
    # A standard deviation is claimed: half of all errors should lie below 0.67 of it.
    assert 0.1 < np.median(claimed) < 3


def test_slants_are_those_of_the_surfaces(found: SceneMap) -> None:
    room, keyframes = BoxRoom(34, texture_px=256), found.keyframes
    steps = np.array([[8.0, 0], [-8, 0], [0, 8], [0, -8], [0, 0]])
    slopes, truths = [], []
    for i, marks in enumerate(keyframes.landmarks):
        pose, camera = keyframes.base_from_camera[i], keyframes.cameras[i]
        rays = camera.unproject(marks.pixels[None] + steps[:, None])
        turned = rays @ pose.rotation_matrix().T
        near = np.stack([1 / room.intersect(pose.translation_m, ray)[1] for ray in turned])
        truth = np.stack([near[0] - near[1], near[2] - near[3]], -1) / 16
        # On a plane, inverse depth is linear in the image; elsewhere there is no one slant.
        flat = np.abs(near[:2].mean(0) - near[4]) + np.abs(near[2:4].mean(0) - near[4]) < 1e-6
        slopes.append(marks.slope[flat])
        truths.append(truth[flat])
    slope, truth = np.concatenate(slopes), np.concatenate(truths)
    assert len(slope) > 300
    # Coarse, but better than none.
    assert np.corrcoef(slope.ravel(), truth.ravel())[0, 1] > 0.5
    error = np.linalg.norm(slope - truth, axis=1)
    assert np.median(error) < np.median(np.linalg.norm(truth, axis=1))


def test_right_poses_and_a_right_lens_stay(found: SceneMap, hall: Recording) -> None:
    truth = {f.name: f.base_from_camera for f in hall.train}
    keyframes, stated = found.keyframes, [f for f in hall.train if f.base_from_camera]
    assert len(keyframes) == 7
    for i in range(7):
        pose = keyframes.base_from_camera[i]
        nearest = min(pose_distance(pose, p)[0] for p in truth.values() if p is not None)
        assert nearest < 0.003
    assert found.camera.fx == pytest.approx(stated[0].camera.fx, rel=2e-3)
    adjusted = found.adjusted
    assert adjusted.residual_px < 0.2
    assert adjusted.pose_sigma_mm < 1
    assert adjusted.pose_sigma_deg < 0.05
    assert abs(adjusted.time_shift_frames) < 0.02
    assert (adjusted.wrong_poses, adjusted.doubtful_poses) == ((), ())
    assert 0 < found.pose_sigma[0] < 0.003
    assert 0 < found.pose_sigma[1] < 0.003


def test_steps_are_told_in_order(arcs: tuple[Recording, Recording]) -> None:
    steps = []
    chosen = spread_frames(arcs[0].train, 3)
    work = map_steps(arcs[0].train[:16], load_encoder(), chosen[chosen < 16], SMALL)
    for step in work:
        assert isinstance(step, Mapping)
        assert 0 <= step.done <= step.total
        steps.append(step)
    order = list(dict.fromkeys(step.what for step in steps))
    assert order == ["encoding", "mapping", "adjusting"]
    assert [s.done for s in steps if s.what == "encoding"] == list(range(1, 17))
    assert steps[-1].done == steps[-1].total


def test_a_transform_common_to_all_poses_is_found(arcs: tuple[Recording, Recording]) -> None:
    frames, encoder = arcs[0].train[:18], load_encoder()
    off = SE3.exp(np.array([0, 0, 0, 0.012, -0.02, 0.015]))
    chosen = spread_frames(frames, 4)
    found = build_map(moved(frames, off.inverse()), encoder, chosen, SMALL)
    # Adjusted = stated @ common, and stated = true @ off^-1.
    _, radians = pose_distance(found.common, off)
    assert radians < 0.004
    turn = np.deg2rad(found.adjusted.common_rotation_deg)
    np.testing.assert_allclose(turn, off.log()[3:], atol=4e-3)
    # Frames as the map sees them stand where they really were.
    seen = found.adjusted_frames(moved(frames, off.inverse()))
    assert [frame.name for frame in seen] == [frame.name for frame in frames]
    for frame, true in zip(seen, frames, strict=True):
        assert frame.base_from_camera is not None
        assert true.base_from_camera is not None
        assert pose_distance(frame.base_from_camera, true.base_from_camera)[1] < 0.004
        assert frame.camera == found.camera


def test_a_wrong_clock_bends_no_frame(arcs: tuple[Recording, Recording]) -> None:
    """Answers are true poses, though poses are stated half a frame after their images."""
    true = [frame.base_from_camera for frame in arcs[0].train]
    frames = [
        replace(frame, base_from_camera=late.base_from_camera)
        for frame, late in zip(arcs[0].train, arcs[0].test, strict=True)
    ]
    chosen = spread_frames(frames, 6)
    found = build_map(frames, load_encoder(), chosen, SMALL)
    assert found.adjusted.time_shift_frames == pytest.approx(-0.5, abs=0.1)
    cell = Cell((0.0, 0.0, 0.0), 1.0, (0.0, 0.0, 0.0))
    plain = SceneRecord("one", frames[0].camera, cell, torch.zeros(0), len(frames))
    record, off, before = mapped_record(plain, found), [], []
    for i, place in enumerate(chosen):
        pose, stated = true[place], frames[place].base_from_camera
        assert pose is not None
        assert stated is not None
        answer, _ = record.stated(found.keyframes.base_from_camera[i], None)
        off.append(pose_distance(answer, pose)[0])
        before.append(pose_distance(stated, pose)[0])
    assert np.median(off) < 0.1 * np.median(before)
    # A network beside the map learns them at the time of their images; the ends have no velocity.
    seen = found.adjusted_frames(frames)[1:-1]
    off = [
        pose_distance(frame.base_from_camera, pose)[0]
        for frame, pose in zip(seen, true[1:-1], strict=True)
        if frame.base_from_camera is not None and pose is not None
    ]
    assert np.median(off) < 0.1 * np.median(before)


STEADY = np.zeros(6)
LENS = Camera(320, 240, 280.0, 280.0, 159.5, 119.5)


@pytest.mark.parametrize(
    ("change", "camera", "noticed"),
    [
        (STEADY, LENS, False),
        (STEADY, None, False),
        (np.array([0.005, 0, 0, 0, 0, 0]), LENS, True),  # as a shift in time does
        (np.array([0, 0, 0, 0, 0.001, 0]), None, True),
        (np.array([1e-5, 0, 0, 0, 1e-5, 0]), LENS, False),
        (np.eye(10, 6), LENS, False),  # some frames only
        (STEADY, replace(LENS, cx=160.0), True),
        (STEADY, replace(LENS, fx=281.0, fy=281.0), True),
        (STEADY, replace(LENS, distortion=(0.02, 0.0, 0.0, 0.0)), True),
        (STEADY, replace(LENS, fx=280.001, cx=159.501), False),
    ],
)
def test_what_landmarks_would_notice(
    change: np.ndarray, camera: Camera | None, noticed: bool
) -> None:
    stated, none = SE3.exp(np.random.default_rng(0).normal(size=(10, 6))), np.zeros((10, 6, 6))
    change = np.broadcast_to(change, (10, 6))
    poses, common, nearness = (
        stated @ SE3.exp(change),
        SE3.identity(),
        np.full(7, 0.5),
    )
    fixed = (0.0, 0.0, 0.0, 0.1, none[0], none[:, 0], np.ones(10), none, nearness)
    assert _moved(stated, LENS, Adjustment(poses, camera, common, *fixed)) == noticed


def test_poses_and_lens_may_be_taken_as_stated(arcs: tuple[Recording, Recording]) -> None:
    frames = arcs[0].train[:10]
    found = build_map(frames, load_encoder(), [2, 7], replace(SMALL, adjust=False))
    assert np.abs(found.common.log()).max() == 0
    assert found.pose_sigma == (0.0, 0.0)
    assert found.camera == frames[0].camera
    for i, frame in ((0, frames[2]), (1, frames[7])):
        assert frame.base_from_camera is not None
        pose = found.keyframes.base_from_camera[i]
        assert pose_distance(pose, frame.base_from_camera)[0] < 1e-9


def test_a_frame_in_the_wrong_place_is_named_and_left_out(hall: Recording) -> None:
    frames = list(hall.train[::2])
    (frames[6],) = moved((frames[6],), SE3.exp(np.array([0, 0.3, 0, 0, 0, 0])))
    chosen = [0, 6, 12]
    found = build_map(frames, load_encoder(), chosen)
    assert found.adjusted.wrong_poses == (frames[6].name,)
    assert len(found.keyframes) == len(found.names) == 3  # another one stands in for it
    assert frames[6].name not in found.names
    left = [frame.name for frame in frames if frame.name != frames[6].name]
    assert [frame.name for frame in found.adjusted_frames(frames)] == left
    wrong = frames[6].base_from_camera
    assert wrong is not None
    places = found.keyframes.base_from_camera
    assert min(pose_distance(places[i], wrong)[0] for i in range(3)) > 0.05
    for number in (0, 12):  # and for no other
        right = frames[number].base_from_camera
        assert right is not None
        assert min(pose_distance(places[i], right)[0] for i in range(3)) < 0.003


def test_frames_from_one_spot_are_refused(arcs: tuple[Recording, Recording]) -> None:
    frames = tuple(
        replace(f, base_from_camera=SE3(f.base_from_camera.rotation_wxyz, np.ones(3)))
        for f in arcs[0].train[:16]
        if f.base_from_camera
    )
    with pytest.raises(InputError, match=r"no two training frames see the same .* parallax"):
        build_map(frames, load_encoder(), [0, 8], SMALL)


@pytest.mark.parametrize("scale", [0.05, 10.0])
def test_maps_are_alike_at_other_scales(scale: float, arcs: tuple[Recording, Recording]) -> None:
    frames, encoder = arcs[0].train[:10], load_encoder()
    scaled = [
        replace(f, base_from_camera=SE3(p.rotation_wxyz, scale * p.translation_m))
        for f in frames
        if (p := f.base_from_camera) is not None
    ]
    depths = []
    for recorded in (frames, scaled):
        found = build_map(recorded, encoder, [2, 7], SMALL)
        assert found.adjusted.wrong_poses == ()
        depths.append(np.concatenate([1 / m.inverse_depth for m in found.keyframes.landmarks]))
    assert len(depths[1]) > 0.9 * len(depths[0])
    assert np.median(depths[1]) == pytest.approx(scale * np.median(depths[0]), rel=0.03)


def test_the_same_frames_give_the_same_map(arcs: tuple[Recording, Recording]) -> None:
    frames, encoder = arcs[1].train[:10], load_encoder()
    one, two = (build_map(frames, encoder, [2, 7], SMALL) for _ in range(2))
    a, b = one.keyframes.to_tensors(), two.keyframes.to_tensors()
    assert a.keys() == b.keys()
    for name, value in a.items():
        np.testing.assert_array_equal(value, b[name])
    assert one.adjusted == two.adjusted


@pytest.mark.parametrize("capacity", [1, 5, 24, 100])
def test_frames_are_spread(capacity: int, arcs: tuple[Recording, Recording]) -> None:
    chosen = spread_frames(arcs[0].train, capacity).tolist()
    assert len(chosen) == min(capacity, 24)
    assert chosen == sorted(set(chosen))
