"""What a learned map knows to be wrong about its recording, in sentences."""

import math
from collections.abc import Iterator

from evercal.geometry import Camera
from evercal.mapping.built_map import MOST_FOCAL_PERCENT, Adjusted
from evercal.storage.text_files import few
from evercal.typing import JsonObject

MOST_CORNER_PX = 3.0
"""Change of the corners of the image by adjusted intrinsics, pixels."""
MOST_SHIFT_FRAMES = 0.02
"""Lag of the images that is no warning, frame intervals."""
SIGNIFICANT = 5.0
"""Standard deviations of a common transform that the images require."""
LEAST_MM = 3.0
"""Smaller common translations are no warning: two good hand-eye calibrations differ by as much."""
LEAST_DEG = 0.3
"""The same for rotations."""
LEAST_SHARED_MM = 1.0
"""Smaller shared errors of the stated positions are no warning: those of a map's answers."""
DEPTHS_M = (0.03, 15.0)
"""Median depths of recordings in metres: a wrist camera before a part, and a hall."""


def stated_warnings(adjusted: Adjusted, camera_stated: bool) -> Iterator[str]:
    """Contradictions between what a recording states and its images.

    With `camera_stated`, the poses are those of the camera; else those of a gripper, and the
    common transform is no mistake.
    """
    yield from _depth(adjusted)
    if camera_stated:
        yield from _common(adjusted)
        yield from _shared(adjusted)
    yield from _intrinsics(adjusted)
    yield from _changed_lens(adjusted)
    if abs(adjusted.time_shift_frames) > MOST_SHIFT_FRAMES:
        yield (
            f"the images lag their stated poses by {adjusted.time_shift_frames:+.2f} frame"
            " intervals; check the clocks"
        )
    if adjusted.wrong_poses:
        names = few(adjusted.wrong_poses, most=8)
        yield f"poses that contradict the images, left out: {names}"
    if adjusted.doubtful_poses:
        names = few(adjusted.doubtful_poses, most=8)
        yield f"poses with large errors, given less weight: {names}"


def _depth(adjusted: Adjusted) -> Iterator[str]:
    depth = adjusted.depth_m
    if depth is not None and not DEPTHS_M[0] < depth < DEPTHS_M[1]:
        yield (
            f"the usual depth is {depth:.3g} m: is the unit of the poses the metre, or inches or"
            " millimetres? All answers have it"
        )


def _common(adjusted: Adjusted) -> Iterator[str]:
    found = []
    for vector, sigma, least, unit in (
        (adjusted.common_translation_mm, adjusted.common_sigma_mm, LEAST_MM, "mm"),
        (adjusted.common_rotation_deg, adjusted.common_sigma_deg, LEAST_DEG, "deg"),
    ):
        size = math.hypot(*(vector or ()))
        if sigma is not None and size > max(least, SIGNIFICANT * sigma):
            axes = ", ".join(map("{:+.2f}".format, vector or ()))
            found.append(f"{size:.2f} +- {sigma:.2f} {unit} ({axes} of its x, y, z)")
    if found:
        yield (
            f"the camera is {' and '.join(found)} from where its poses say, and answers keep this"
            " offset: correct the mount (gripper_from_camera) or the intrinsics and learn again,"
            " or state gripper poses, from which the mount is estimated"
        )


def _shared(adjusted: Adjusted) -> Iterator[str]:
    shared = adjusted.shared_mm or 0.0
    if shared > LEAST_SHARED_MM:
        yield (
            f"the stated positions deform smoothly, by {shared:.1f} mm per axis from what the"
            " images show, and answers follow them: an arm that sags or was moved, a tracker that"
            " drifts, or an axis of another scale"
        )


def _intrinsics(adjusted: Adjusted) -> Iterator[str]:
    if abs(adjusted.focal_percent) > MOST_FOCAL_PERCENT:
        yield (
            "images and stated poses ask for a focal length"
            f" {adjusted.focal_percent:+.1f} % from the stated one; the intrinsics or the scale of"
            " the poses are wrong"
        )
    if adjusted.corner_px > MOST_CORNER_PX:
        stated, now = map(_pinhole, adjusted.intrinsics)
        yield (
            f"the images move the corners of the image by {adjusted.corner_px:.1f} px: fx, fy, cx,"
            f" cy and distortion are stated as {stated}, adjusted {now}; check the camera file"
        )


def _changed_lens(adjusted: Adjusted) -> Iterator[str]:
    change = adjusted.focal_change
    if not change:
        return
    how = f"differs by {100 * change:.1f} % (standard deviation) from image to image"
    if adjusted.focal_change_at:
        how = f"changes by {100 * change:+.1f} % or more at {adjusted.focal_change_at}"
    yield (
        f"the focal length {how}, as by autofocus or another zoom: fix both and record again"
    )


def _pinhole(record: JsonObject) -> str:
    camera = Camera.from_dict(record)
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)
    return " ".join(map("{:.5g}".format, numbers))
