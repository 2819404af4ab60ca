"""Recordings of a camera on the arm: gripper poses are known, `gripper_from_camera` is not."""

from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from evercal.calibration.eye_in_hand_start import HandEyeStart, hand_eye_start, with_gripper
from evercal.errors import InputError
from evercal.features.encoder import Encoder
from evercal.geometry.pose_covariance import with_translation_by
from evercal.geometry.se3 import SE3, pose_distance_mm_deg
from evercal.mapping.build import Adjusted, Mapping, SceneMap
from evercal.recordings.frame import Recording

MOST_FOCAL_PERCENT, MOST_POSE_SIGMA_MM = 1.0, 5.0
"""Beyond these, errors are systematic and the covariance says nothing about them."""


@dataclass(frozen=True)
class HandEyeReport:
    """Where the camera was found on the gripper, as JSON values."""

    translation_m: tuple[float, ...]
    """Of gripper_from_camera."""
    quaternion_wxyz: tuple[float, ...]
    """Of gripper_from_camera."""
    covariance: tuple[tuple[float, ...], ...]
    """(6, 6) of translation in the gripper frame, metres, and rotation about camera axes,
    radians."""
    pairs: int
    """Pairs of frames whose motion agrees with it."""
    of_pairs: int
    """Pairs of frames whose motion was found."""
    start_mm: float
    """How far bundle adjustment moved the start."""
    start_deg: float
    """The same for the rotation."""
    given_mm: float | None = None
    """How far it lies from a `gripper_from_camera` that was given."""
    given_deg: float | None = None
    """The same for the rotation."""
    doubts: tuple[str, ...] = ()
    """Why it should not be relied on; empty if nothing speaks against it."""

    @property
    def gripper_from_camera(self) -> SE3:
        """The transform."""
        return SE3(np.array(self.quaternion_wxyz), np.array(self.translation_m))


def lacks_camera_poses(scene: Recording) -> bool:
    """Whether a recording states where the gripper was, but never where the camera was."""
    stated = any(frame.base_from_camera is not None for frame in scene.train)
    return not stated and any(frame.base_from_gripper is not None for frame in scene.train)


def posed_by_gripper(
    scene: Recording, encoder: Encoder, on_event: Callable[[Mapping], object]
) -> tuple[Recording, HandEyeStart]:
    """The recording with the camera poses that a first `gripper_from_camera` gives.

    Args:
        scene: frames without a gripper pose count as untracked.
        encoder: tells which frames look alike.
        on_event: called as pairs of frames are matched.

    Raises:
        InputError: see `hand_eye_start`; the message begins with the scene's name.
    """
    frames = tuple(frame for frame in scene.train if frame.base_from_gripper is not None)
    try:
        start = _run(hand_eye_start(frames, encoder), on_event)
    except InputError as error:
        raise InputError(f"{scene.name}: {error}") from None
    lost = len(scene.train) - len(frames)
    train = with_gripper(frames, start.gripper_from_camera)
    return replace(scene, train=train, untracked=scene.untracked + lost), start


def hand_eye_report(
    start: HandEyeStart, scene_map: SceneMap, given: SE3 | None = None
) -> HandEyeReport:
    """What was found, once the map is adjusted."""
    correction = scene_map.hand_eye
    assert correction is not None, "the map was built for a hand-eye calibration"
    found = start.gripper_from_camera @ correction.start_camera_from_camera
    axes = start.gripper_from_camera.rotation_matrix()
    covariance = with_translation_by(axes, correction.covariance)
    doubts = _doubts(scene_map.adjusted)
    moved = pose_distance_mm_deg(found, start.gripper_from_camera)
    off = (None, None) if given is None else pose_distance_mm_deg(found, given)
    return HandEyeReport(
        tuple(found.translation_m.tolist()),
        tuple(found.rotation_wxyz.tolist()),
        tuple(tuple(row) for row in ((covariance + covariance.T) / 2).tolist()),
        start.pairs,
        start.of_pairs,
        *moved,
        *off,
        doubts,
    )


def _doubts(adjusted: Adjusted) -> tuple[str, ...]:
    """What the covariance does not know: a wrong lens or wrong poses bend the answer."""
    found = []
    if abs(adjusted.focal_percent) > MOST_FOCAL_PERCENT:
        found.append(
            f"the images ask for a focal length {adjusted.focal_percent:+.1f} % from the stated"
            " one: calibrate the lens first ('evercal detect' on images of a board)"
        )
    if adjusted.pose_sigma_mm > MOST_POSE_SIGMA_MM:
        found.append(
            f"the gripper poses fit the images to {adjusted.pose_sigma_mm:.0f} mm only: let the arm"
            " stand still at every image, and check the clocks"
        )
    return tuple(found)


def _run(
    steps: Generator[tuple[int, int], None, HandEyeStart], on_event: Callable[[Mapping], Any]
) -> HandEyeStart:
    while True:
        try:
            done, total = next(steps)
        except StopIteration as end:
            return end.value
        on_event(Mapping("matching", done, total))
