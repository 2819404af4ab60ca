"""`build_map` in a room whose surfaces are known in closed form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.features.encoder import Encoder, load_encoder
from evercal.geometry import SE3, Camera, UncertainPose, pose_distance
from evercal.mapping import build
from evercal.mapping.build import MapOptions, _moved, build_map, spread_frames
from evercal.mapping.built_map import BuiltMap, HandEyeCorrection
from evercal.mapping.bundle_adjustment import BundleAdjustment
from evercal.mapping.bundle_equations import Adjustment
from evercal.mapping.keyframes import Keyframes
from evercal.mapping.memory_budget import MemoryBudget
from evercal.mapping.prepared_frames import PreparedFrames, WorkingSize
from evercal.processes import cores
from evercal.recordings.frame import Frame, Recording
from evercal.simulation.box_room import BoxRoom

SMALL = MapOptions(
    size=WorkingSize(cells=120, patches=120), memory=MemoryBudget(share=0.2)
)


@pytest.fixture(scope="module")
def encoder() -> Encoder:
    return load_encoder()


def moved(frames: Sequence[Frame], change: SE3) -> list[Frame]:
    """Frames with all poses multiplied by a change on the right."""
    return [replace(f, base_from_camera=pose_of(f) @ change) for f in frames]


def pose_of(frame: Frame) -> SE3:
    assert frame.base_from_camera is not None
    return frame.base_from_camera


def rays_of(keyframes: Keyframes, i: int, pixels: np.ndarray) -> np.ndarray:
    """Rays of pixels (..., 2) of a keyframe in the base frame."""
    rotation = keyframes.base_from_camera[i].rotation_matrix()
    return keyframes.cameras[i].unproject(pixels) @ rotation.T


def test_landmarks_lie_on_the_surfaces(
    hall_built: BuiltMap, hall_room: BoxRoom
) -> None:
    keyframes = hall_built.scene.keyframes
    errors = []
    standardised = []
    for i, marks in enumerate(keyframes.landmarks):
        assert len(marks) > 100
        position = keyframes.base_from_camera[i].translation_m
        _, depth = hall_room.intersect(position, rays_of(keyframes, i, marks.pixels))
        errors.append(np.abs(1 / marks.inverse_depth / depth - 1))
        standardised.append(np.abs(marks.inverse_depth - 1 / depth) / marks.sigma)
    error = np.concatenate(errors)
    assert np.median(error) < 0.003
    assert np.quantile(error, 0.9) < 0.02
    # Half of all Gaussian errors lie below 0.67 standard deviations.
    assert 0.1 < np.median(np.concatenate(standardised)) < 3


def test_slants_are_those_of_the_surfaces(
    hall_built: BuiltMap, hall_room: BoxRoom
) -> None:
    keyframes = hall_built.scene.keyframes
    steps = np.array([[8.0, 0], [-8, 0], [0, 8], [0, -8], [0, 0]])
    slopes = []
    truths = []
    for i, marks in enumerate(keyframes.landmarks):
        position = keyframes.base_from_camera[i].translation_m
        rays = rays_of(keyframes, i, marks.pixels[None] + steps[:, None])
        rho = np.stack([1 / hall_room.intersect(position, ray)[1] for ray in rays])
        truth = np.stack([rho[0] - rho[1], rho[2] - rho[3]], -1) / 16
        # On a plane, inverse depth is linear in the image; an edge has no slant.
        flat = (
            np.abs(rho[:2].mean(0) - rho[4]) + np.abs(rho[2:4].mean(0) - rho[4]) < 1e-6
        )
        slopes.append(marks.slope[flat])
        truths.append(truth[flat])
    slope = np.concatenate(slopes)
    truth = np.concatenate(truths)
    assert len(slope) > 300
    # The slants are coarse, but better than zero.
    assert np.corrcoef(slope.ravel(), truth.ravel())[0, 1] > 0.5
    error = np.linalg.norm(slope - truth, axis=1)
    assert np.median(error) < np.median(np.linalg.norm(truth, axis=1))


def test_exact_poses_and_intrinsics_hardly_change(
    hall_built: BuiltMap, hall: Recording
) -> None:
    truth = {frame.name: pose_of(frame) for frame in hall.train}
    scene = hall_built.scene
    adjusted = hall_built.adjusted
    assert len(scene.keyframes) == len(hall_built.keyframe_names) == 7
    for i, name in enumerate(hall_built.keyframe_names):
        assert (
            pose_distance(scene.keyframes.base_from_camera[i], truth[name])[0] < 0.003
        )
    assert scene.adjusted_camera.fx == pytest.approx(hall.train[0].camera.fx, rel=2e-3)
    assert adjusted.residual_px is not None
    assert adjusted.residual_px < 0.2
    assert adjusted.pose_sigma_mm is not None
    assert adjusted.pose_sigma_mm < 1
    assert adjusted.pose_sigma_deg < 0.05
    assert abs(adjusted.time_shift_frames) < 0.02
    assert (adjusted.wrong_poses, adjusted.doubtful_poses) == ((), ())
    assert 0 < scene.frame.pose_sigma[0] < 0.003
    assert 0 < scene.frame.pose_sigma[1] < 0.003


def test_steps_are_reported_in_order(
    arcs: tuple[Recording, Recording], encoder: Encoder
) -> None:
    steps: list[tuple[str, int, int]] = []
    build_map("a", arcs[0].train[:16], encoder, SMALL, lambda *step: steps.append(step))
    assert list(dict.fromkeys(what for what, _, _ in steps)) == [
        "encoding",
        "mapping",
        "adjusting",
    ]
    assert [done for what, done, _ in steps if what == "encoding"] == list(range(1, 17))
    assert all(0 <= done <= total for _, done, total in steps)
    assert steps[-1][1] == steps[-1][2]


def test_common_transform_is_estimated(
    arcs: tuple[Recording, Recording], encoder: Encoder
) -> None:
    change = SE3.exp(np.array([0, 0, 0, 0.012, -0.02, 0.015]))
    built = build_map("a", moved(arcs[0].train[:18], change.inverse()), encoder, SMALL)
    # Adjusted = stated @ common, and stated = true @ change^-1.
    assert pose_distance(built.scene.frame.common, change)[1] < 0.004
    rotation = np.deg2rad(built.adjusted.common_rotation_deg)
    np.testing.assert_allclose(rotation, change.log()[3:], atol=4e-3)


def test_time_shift_is_undone(
    arcs: tuple[Recording, Recording], encoder: Encoder
) -> None:
    """Answers are true poses, though poses are stated half a frame after their images."""
    true = {frame.name: pose_of(frame) for frame in arcs[0].train}
    frames = [
        replace(frame, base_from_camera=late.base_from_camera)
        for frame, late in zip(arcs[0].train, arcs[0].test, strict=True)
    ]
    built = build_map(
        "a", frames, encoder, replace(SMALL, memory=MemoryBudget(share=0.25))
    )
    assert built.adjusted.time_shift_frames == pytest.approx(-0.5, abs=0.1)
    stated = {frame.name: pose_of(frame) for frame in frames}
    before = []
    after = []
    for i, name in enumerate(built.keyframe_names):
        pose = UncertainPose.exact(built.scene.keyframes.base_from_camera[i])
        after.append(pose_distance(built.scene.frame.to_base(pose).pose, true[name])[0])
        before.append(pose_distance(stated[name], true[name])[0])
    assert np.median(after) < 0.1 * np.median(before)


STEADY = np.zeros(6)
CAMERA = Camera(320, 240, 280.0, 280.0, 159.5, 119.5)


@pytest.mark.parametrize(
    ("change", "camera", "noticeable"),
    [
        (STEADY, CAMERA, False),
        (STEADY, None, False),
        (np.array([0.005, 0, 0, 0, 0, 0]), CAMERA, True),
        (np.array([0, 0, 0, 0, 0.001, 0]), None, True),
        (np.array([1e-5, 0, 0, 0, 1e-5, 0]), CAMERA, False),
        (np.eye(10, 6), CAMERA, False),  # less than half of the frames
        (STEADY, replace(CAMERA, cx=160.0), True),
        (STEADY, replace(CAMERA, fx=281.0, fy=281.0), True),
        (STEADY, replace(CAMERA, distortion=(0.02, 0.0, 0.0, 0.0)), True),
        (STEADY, replace(CAMERA, fx=280.001, cx=159.501), False),
    ],
)
def test_landmarks_are_tracked_again_after_noticeable_changes(
    change: np.ndarray, camera: Camera | None, noticeable: bool
) -> None:
    stated = SE3.exp(np.random.default_rng(0).normal(size=(10, 6)))
    zero = np.zeros((10, 6, 6))
    adjustment = Adjustment(
        poses=stated @ SE3.exp(np.broadcast_to(change, (10, 6))),
        cameras=camera and [camera] * 10,
        common=SE3.identity(),
        shift_frames=0.0,
        sigma_m=0.0,
        sigma_rad=0.0,
        residual_px=0.1,
        lens_covariance=np.zeros((14, 14)),
        lens_systematic=np.zeros((14, 14)),
        correction=zero[:, 0],
        errors=zero[:, 0],
        left_out=zero[:, 0],
        weight=np.ones(10),
        covariance=zero,
        inverse_depth=np.full(7, 0.5),
        focal_changes=np.full((3, 2), np.nan),
        offsets=np.zeros(0),
        offsets_covariance=np.zeros((0, 0)),
        offsets_prior=np.zeros(0),
        offsets_known=np.zeros(0, dtype=bool),
    )
    assert _moved(stated, CAMERA, adjustment) == noticeable


def test_map_without_adjustment_is_stored(
    arcs: tuple[Recording, Recording], tmp_path: Path
) -> None:
    from evercal.map import Map

    frames = arcs[0].train
    robot = Map.open(tmp_path / "map")
    recording = Recording("one", frames, ())
    report = robot.learn(recording, options=replace(SMALL, adjust=False), memory="15%")
    assert report.adjusted is not None
    assert report.adjusted.residual_px is None
    again = Map.open(tmp_path / "map")
    assert again.scenes == ("one",)
    (scene,) = again.localizer.contents.scenes
    assert np.abs(scene.frame.common.log()).max() == 0
    assert scene.frame.pose_sigma == (0.0, 0.0)
    assert scene.adjusted_camera == frames[0].camera
    stated = SE3.stack([pose_of(frame) for frame in frames])
    for pose in scene.keyframes.base_from_camera:
        assert pose_distance(stated, pose)[0].min() < 1e-9


def test_frame_with_a_wrong_pose_is_excluded(hall: Recording, encoder: Encoder) -> None:
    frames = list(hall.train[::2])
    options = MapOptions(memory=MemoryBudget(share=0.5))
    wrong = int(spread_frames(frames, 7)[3])
    frames[wrong : wrong + 1] = moved(
        frames[wrong : wrong + 1], SE3.exp(np.array([0, 0.3, 0, 0, 0, 0]))
    )
    built = build_map("hall", frames, encoder, options)
    assert built.adjusted.wrong_poses == (frames[wrong].name,)
    # Another one replaces it.
    assert len(built.scene.keyframes) == len(built.keyframe_names) == 7
    stated = {frame.name: pose_of(frame) for frame in frames}
    assert frames[wrong].name not in built.keyframe_names
    for i, name in enumerate(built.keyframe_names):
        assert (
            pose_distance(built.scene.keyframes.base_from_camera[i], stated[name])[0]
            < 0.003
        )


def test_frames_with_one_position_are_refused(
    arcs: tuple[Recording, Recording], encoder: Encoder
) -> None:
    frames = [
        replace(f, base_from_camera=SE3(pose_of(f).rotation_wxyz, np.ones(3)))
        for f in arcs[0].train[:16]
    ]
    with pytest.raises(
        InputError, match=r"no two training frames show the same .* parallax"
    ):
        build_map("a", frames, encoder, SMALL)


@pytest.mark.parametrize("scale", [0.05, 10.0])
def test_maps_are_similar_at_other_scales(
    scale: float, arcs: tuple[Recording, Recording], encoder: Encoder
) -> None:
    frames = arcs[0].train[:10]
    scaled = [
        replace(f, base_from_camera=SE3(pose.rotation_wxyz, scale * pose.translation_m))
        for f in frames
        for pose in [pose_of(f)]
    ]
    depths = []
    for recorded in (frames, scaled):
        built = build_map("a", recorded, encoder, SMALL)
        assert built.adjusted.wrong_poses == ()
        marks = built.scene.keyframes.landmarks
        depths.append(np.concatenate([1 / m.inverse_depth for m in marks]))
    assert len(depths[1]) > 0.9 * len(depths[0])
    assert np.median(depths[1]) == pytest.approx(scale * np.median(depths[0]), rel=0.03)


def test_maps_are_deterministic(
    arcs: tuple[Recording, Recording], encoder: Encoder
) -> None:
    one, two = (build_map("a", arcs[1].train[:10], encoder, SMALL) for _ in range(2))
    a = one.scene.keyframes.to_tensors()
    b = two.scene.keyframes.to_tensors()
    assert a.keys() == b.keys()
    for name, value in a.items():
        np.testing.assert_array_equal(value, b[name])
    assert one.adjusted == two.adjusted


@pytest.mark.parametrize("capacity", [1, 5, 24, 100])
def test_spread_frames_fill_the_capacity(
    capacity: int, arcs: tuple[Recording, Recording]
) -> None:
    selected = spread_frames(arcs[0].train, capacity).tolist()
    assert len(selected) == min(capacity, 24)
    assert selected == sorted(set(selected))


def test_parts_are_left_out_with_the_keyframes_near_them(
    hall: Recording, hall_built: BuiltMap
) -> None:
    # The hall has 30 frames: one part in its middle, or two.
    frames = hall.train
    built = replace(hall_built, keyframe_names=tuple(f.name for f in frames[::5][:7]))
    parts = built.left_out(frames)
    assert parts
    numbers = {frame.name: i for i, frame in enumerate(frames)}
    recorded = np.array([numbers[name] for name in built.keyframe_names])
    for part in parts:
        middle = np.mean([numbers[frame.name] for frame in part.frames])
        away = np.abs(recorded - middle)
        assert set(part.keyframes.tolist()) == set(np.flatnonzero(away > 10).tolist())
        assert 0 < len(part.keyframes) < len(recorded)
    assert built.left_out(frames[:29]) == []
    none: dict[str, np.ndarray] = {}
    start = SE3.identity()
    one = np.eye(6)
    moved = HandEyeCorrection(start, one, one, one, none, none, none)
    assert replace(built, hand_eye=moved).left_out(frames) == []


@pytest.mark.parametrize(("noticeable", "rounds"), [(True, 2), (False, 1)])
def test_depths_are_refined_again_only_where_poses_moved(
    noticeable: bool,
    rounds: int,
    rooms: tuple[Recording, ...],
    encoder: Encoder,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    solved = list[object]()
    solve = BundleAdjustment.solve
    monkeypatch.setattr(build, "_moved", lambda *_: noticeable)
    monkeypatch.setattr(
        BundleAdjustment,
        "solve",
        lambda self, tracks: solved.append(self) or solve(self, tracks),
    )
    options = replace(SMALL, size=WorkingSize(cells=64, patches=64))
    build_map("room", rooms[0].train[:16], encoder, options)
    assert len(solved) == rounds


def test_memory_of_pyramids_does_not_grow_with_the_recording(hall: Recording) -> None:
    prepared = PreparedFrames(hall.train, load_encoder(), WorkingSize())
    first = prepared.pyramid(0)[2]
    for i in range(len(prepared)):
        prepared.pyramid(i)
    assert prepared._pyramid.cache_info().currsize == 16 * cores() < len(prepared)
    assert (prepared.pyramid(0)[2] == first).all()
