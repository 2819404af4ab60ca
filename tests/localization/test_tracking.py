"""Streams: tracked, lost, found again, within a time budget."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from evercal.features.views import working_grey
from evercal.geometry import SE3, UncertainPose, pose_distance
from evercal.localization import tracking
from evercal.localization.estimate import PoseEstimate
from evercal.localization.image_motion import followed
from evercal.localization.localizer import Localizer
from evercal.localization.scene_poses import ScenePoses
from evercal.localization.tracking import Tracker, TrackOptions
from evercal.mapping.scene_map import MapContents
from evercal.recordings.frame import Recording
from evercal.simulation.box_room import BoxRoom


@pytest.fixture(scope="module")
def views(hall: Recording, hall_room: BoxRoom) -> list[tuple[np.ndarray, SE3]]:
    """40 views along the middle of the recording's path, 15 a second at 0.1 m/s."""
    a = hall.test[10].base_from_camera
    b = hall.test[16].base_from_camera
    assert a is not None
    assert b is not None
    step = (a.inverse() @ b).log()
    poses = [a @ SE3.exp(s * step) for s in np.linspace(0, 1, 16)]
    return [(hall_room.render(hall.train[0].camera, pose), pose) for pose in poses]


def test_frames_are_tracked_as_exactly_as_single_images(
    hall_map: MapContents, views: list[tuple[np.ndarray, SE3]]
) -> None:
    tracker = Tracker(Localizer(hall_map))
    localizer = Localizer(hall_map)
    frames = [tracker.track(image, i / 15) for i, (image, _) in enumerate(views)]
    assert frames[0].state == "relocalized"
    assert {frame.state for frame in frames[2:]} == {"tracking"}
    errors = []
    for frame, (image, pose) in zip(frames, views, strict=True):
        for estimate in (frame.estimate, localizer.localize(image)):
            assert estimate.base_from_camera is not None
            errors.append(float(pose_distance(estimate.base_from_camera, pose)[0]))
    tracked, single = np.array(errors).reshape(-1, 2).T
    assert np.median(tracked) < 1.3 * np.median(single) + 1e-4
    assert tracked.max() < 0.01


def test_a_covered_lens_is_lost_and_found_within_two_frames(
    hall_map: MapContents, views: list[tuple[np.ndarray, SE3]]
) -> None:
    images = [image for image, _ in views]
    images[5:9] = [np.zeros_like(images[0])] * 4
    states = [frame.state for frame in Tracker(Localizer(hall_map)).frames(images)]
    assert states[2:5] == ["tracking"] * 3
    assert states[5:9] == ["lost"] * 4
    assert "relocalized" in states[9:11]
    assert states[11:] == ["tracking"] * 5


def test_a_jump_is_located_from_nothing(
    hall: Recording, hall_map: MapContents, views: list[tuple[np.ndarray, SE3]]
) -> None:
    tracker = Tracker(Localizer(hall_map))
    for image, _ in views[:4]:
        tracker.track(image)
    far = hall.test[-1]
    frame = tracker.track(far.read_image())
    assert frame.state == "relocalized"
    assert frame.estimate.base_from_camera is not None
    assert far.base_from_camera is not None
    assert (
        pose_distance(frame.estimate.base_from_camera, far.base_from_camera)[0] < 0.01
    )


def test_where_a_period_of_texture_is_in_reach_the_frame_is_located_from_nothing(
    hall_map: MapContents,
    views: list[tuple[np.ndarray, SE3]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    step = np.array([[0.05, 0.0, 0.0]])
    monkeypatch.setattr(ScenePoses, "slips", lambda *_: step)
    tracker = Tracker(Localizer(hall_map))
    image = views[0][0]
    # Without a known motion 0.05 m are possible in a fifteenth of a second, with one in 0.2 s.
    stamps = np.cumsum([0, 1 / 15, 1 / 15, 1 / 15, 0.2, 1 / 15])
    states = [tracker.track(image, float(stamp)).state for stamp in stamps]
    assert states == [
        *["relocalized"] * 2,
        *["tracking"] * 2,
        "relocalized",
        "tracking",
    ]


def test_a_pose_that_is_too_uncertain_is_not_tracked(
    hall_map: MapContents,
    views: list[tuple[np.ndarray, SE3]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tracker = Tracker(Localizer(hall_map))
    for image, _ in views[:3]:
        tracker.track(image)
    answer = tracking.answer

    def useless(*given: Any) -> PoseEstimate:
        monkeypatch.undo()  # the frame is then located from nothing
        return replace(answer(*given), status="unknown_scene", base_from_camera=None)

    monkeypatch.setattr(tracking, "answer", useless)
    frame = tracker.track(views[3][0])
    assert (frame.state, frame.estimate.status) == ("relocalized", "ok")


def test_a_camera_that_turns_by_degrees_is_never_tracked_to_another_minimum(
    hall: Recording,
    hall_map: MapContents,
    hall_room: BoxRoom,
    views: list[tuple[np.ndarray, SE3]],
) -> None:
    # Far beyond what alignment reaches: patches slide to other texture, and some poses passed.
    rng = np.random.default_rng(3)
    camera = hall.train[0].camera
    tracker = Tracker(Localizer(hall_map))
    states: list[str] = []
    for _, pose in views[:10]:
        turn = np.deg2rad(2.5) * rng.choice([-1, 1], 3)
        shaken = pose @ SE3.exp(np.r_[0, 0, 0, turn])
        frame = tracker.track(hall_room.render(camera, shaken))
        assert frame.estimate.base_from_camera is not None
        assert pose_distance(frame.estimate.base_from_camera, shaken)[0] < 0.005
        states.append(frame.state)
    assert states.count("tracking") > 5


def test_fewer_inliers_than_in_the_frames_before_are_no_tracked_pose(
    hall_map: MapContents, views: list[tuple[np.ndarray, SE3]]
) -> None:
    tracker = Tracker(Localizer(hall_map))
    for image, _ in views[:3]:
        tracker.track(image)
    covered = views[3][0].copy()
    covered[:, :140] = 128
    assert tracker.track(covered).state == "relocalized"
    assert tracker.track(covered).state == "tracking"


def test_every_nth_frame_is_located_from_nothing_and_replaces_a_wrong_pose(
    hall_map: MapContents,
    views: list[tuple[np.ndarray, SE3]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tracker = Tracker(Localizer(hall_map), options=TrackOptions(checked=3))
    searched: list[int] = []
    located = Localizer.located

    def counted(*given: Any) -> Any:
        searched.append(tracker._number - 1)
        return located(*given)

    monkeypatch.setattr(Localizer, "located", counted)
    frames = [tracker.track(image) for image, _ in views[:8]]
    assert searched == [0, 3, 6]
    assert {frame.state for frame in frames[1:]} == {"tracking"}
    answer = tracking.answer

    def wrong(*given: Any) -> PoseEstimate:
        estimate = answer(*given)
        aside = SE3.from_translation([0.02, 0, 0])
        assert estimate.base_from_camera is not None
        return replace(estimate, base_from_camera=aside @ estimate.base_from_camera)

    monkeypatch.setattr(tracking, "answer", wrong)
    states = [tracker.track(image).state for image, _ in views[8:11]]
    assert states == ["tracking", "relocalized", "tracking"]


def test_frames_do_not_inherit_the_intrinsics_that_one_of_them_mistook(
    hall_map: MapContents, views: list[tuple[np.ndarray, SE3]]
) -> None:
    tracker = Tracker(Localizer(hall_map))
    for image, _ in views[:4]:
        tracker.track(image)
    tracker._changes[-1] = np.array([0.1, 40.0, 0.0, 0.0, 0.0])
    frame = tracker.track(views[4][0])
    assert frame.state == "tracking"
    assert frame.estimate.base_from_camera is not None
    assert pose_distance(frame.estimate.base_from_camera, views[4][1])[0] < 0.003


def test_landmarks_are_followed_from_image_to_image(
    hall_map: MapContents,
    hall: Recording,
    views: list[tuple[np.ndarray, SE3]],
) -> None:
    localizer = Localizer(hall_map)
    (first, _), (second, truth) = views[0], views[3]
    _, pose = localizer.located(first)
    assert pose is not None
    small = hall_map.short_side
    before, after = (working_grey(image, small) for image in (first, second))
    camera = hall.train[0].camera.short_side_resized(small)
    start = pose.pose.pose
    found = followed(before, pose, after, camera, start)
    assert found is not None
    scene = hall_map.scenes[0]
    truth = scene.frame.from_base(truth)
    assert pose_distance(start, truth)[0] > 0.01
    assert pose_distance(found, truth)[0] < 0.005
    assert followed(before, pose, np.zeros_like(after), camera, start) is None
    assert followed(before, pose, after[:-1], camera, start) is None


def test_a_long_gap_and_time_that_runs_backwards_are_no_prediction(
    hall_map: MapContents, views: list[tuple[np.ndarray, SE3]]
) -> None:
    tracker = Tracker(Localizer(hall_map))
    stamps = (0.0, 0.1, 0.2, 5.0, 5.1, 4.0)
    frames = [tracker.track(views[0][0], stamp) for stamp in stamps]
    assert [frame.state for frame in frames][2:] == [
        "tracking",
        "relocalized",
        "tracking",
        "relocalized",
    ]


def test_a_time_for_a_frame_is_kept_while_frames_are_located(
    hall_map: MapContents, views: list[tuple[np.ndarray, SE3]]
) -> None:
    localizer = Localizer(hall_map)
    images = [image for image, _ in views]
    localizer.localize(images[0])
    slow = Localizer.located
    ended = threading.Event()

    def located(self: Localizer, *given: Any) -> Any:
        ended.wait(30)
        return slow(self, *given)

    tracker = Tracker(localizer, options=TrackOptions(at_most_ms=100.0))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Localizer, "located", located)
        frames = [tracker.track(images[0], 0.0), tracker.track(images[1], 0.02)]
        ended.set()
        deadline = time.monotonic() + 30
        while (frame := tracker.track(images[2], 0.04)).state == "lost":
            assert time.monotonic() < deadline
            frames.append(frame)
    assert {frame.state for frame in frames} == {"lost"}
    assert all("localization" in frame.estimate.omitted for frame in frames)
    assert frame.state == "relocalized"
    pose = frame.estimate.base_from_camera
    assert pose is not None
    assert pose_distance(pose, views[2][1])[0] < 0.01
    assert tracker.track(images[3], 0.06).state == "tracking"


def test_a_dark_frame_ends_the_tracking_in_time(
    hall_map: MapContents, views: list[tuple[np.ndarray, SE3]]
) -> None:
    localizer = Localizer(hall_map)
    images = [image for image, _ in views]
    localizer.localize(images[0])
    tracker = Tracker(localizer, options=TrackOptions(at_most_ms=1000.0))
    assert [
        tracker.track(image, 0.1 * i).state for i, image in enumerate(images[:3])
    ] == [
        "relocalized",
        "tracking",
        "tracking",
    ]
    tracker.options = TrackOptions(at_most_ms=1.0)
    dark = tracker.track(np.zeros_like(images[0]), 0.3)
    assert (dark.state, dark.estimate.base_from_camera) == ("lost", None)
    assert "localization" in dark.estimate.omitted


def smoothed(
    positions_m: list[float], sigma_m: float = 0.001
) -> tuple[list[float], list[bool]]:
    """Feed positions along x to the smoother of a tracker without a map."""
    tracker = Tracker.__new__(Tracker)
    tracker.options = TrackOptions(smooth=0.5)
    tracker._smoothed = None
    values: list[float] = []
    jumps: list[bool] = []
    lost = PoseEstimate.failed("")
    for i, x in enumerate(positions_m):
        pose = SE3.from_translation([x, 0, 0])
        uncertain = UncertainPose(pose, sigma_m**2 * np.eye(6))
        estimate = PoseEstimate(
            "ok", "", "room", uncertain.pose, uncertain.covariance, 9, 1.0, 1.0
        )
        now, jumped = tracker._smooth(estimate, i / 15)
        assert now is not None
        values.append(float(now.translation_m[0]))
        jumps.append(jumped)
    tracker._smooth(lost, 9.0)
    assert tracker._smoothed is None
    return values, jumps


def test_smoothing_reduces_noise_and_never_hides_a_jump() -> None:
    rng = np.random.default_rng(0)
    noisy = (0.001 * rng.normal(size=60)).tolist()
    values, jumps = smoothed(noisy)
    assert np.std(values[20:]) < 0.5 * np.std(noisy[20:])
    assert jumps == [True] + [False] * 59
    values, jumps = smoothed([0.0] * 5 + [0.05] * 5)
    assert values == [0.0] * 5 + [0.05] * 5
    assert jumps[5]
