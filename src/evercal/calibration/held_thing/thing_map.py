"""The map of a thing that the gripper holds: its frames, and the scatter of its images."""

from collections.abc import Sequence
from dataclasses import replace

from evercal.calibration.from_map.hand_eye import HandEye
from evercal.calibration.from_map.hand_eye_start import HandEyeStart
from evercal.calibration.held_thing.windows import cropped, windows
from evercal.geometry import SE3, Camera, deviations
from evercal.mapping.scene_map import SceneMap
from evercal.recordings.frame import Frame, Recording


def in_windows(
    recording: Recording, whole: Sequence[Frame], start: HandEyeStart
) -> Recording:
    """The recording with windows around the thing instead of reduced images, if it is small.

    Windows are cut from the images of `whole` (n,), which those of the recording were reduced from.
    """
    posed = start.posed(recording, whole).train
    around = windows(posed, start)
    if around is None:
        return recording
    return replace(recording, train=tuple(map(cropped, posed, around)))


def of_whole_images(scene: SceneMap, whole: Camera) -> SceneMap:
    """The map of a thing in the gripper, with the camera of whole images.

    It was built from windows, or from reduced images.
    """
    window = scene.camera
    width = round(window.width * whole.fx / window.fx)
    height = round(window.height * whole.fy / window.fy)
    window = window.resized(width, height)
    adjusted = scene.adjusted_camera.resized(width, height)
    adjusted = replace(
        adjusted,
        width=whole.width,
        height=whole.height,
        cx=whole.cx + (adjusted.cx - window.cx),
        cy=whole.cy + (adjusted.cy - window.cy),
    )
    return replace(
        scene, camera=whole, adjusted_camera=adjusted, parent_frame="gripper"
    )


def with_image_scatter(
    estimate: HandEye,
    frames: Sequence[Frame],
    gripper_from_camera: Sequence[SE3 | None],
) -> HandEye:
    """The estimate with the scatter of single images, which `check` compares a shift with.

    `gripper_from_camera` are the poses of n frames in the finished map, None of those that are not
    located. Gripper poses lead to the base.
    """
    base_from_camera = []
    for frame, pose in zip(frames, gripper_from_camera, strict=True):
        if pose and frame.base_from_gripper:
            base_from_camera.append(frame.base_from_gripper @ pose)
    if len(base_from_camera) < 2:
        return estimate
    calibration = estimate.calibration
    deviation = deviations(
        SE3.stack(base_from_camera), estimate.parent_from_camera.pose
    )
    scatter = deviation.T @ deviation / len(deviation)
    checks = replace(
        calibration.checks,
        images_used=len(deviation),
        image_scatter=scatter.tolist(),
    )
    return replace(estimate, calibration=replace(calibration, checks=checks))
