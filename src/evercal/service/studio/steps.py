"""The steps of the studio, each with its state."""

from collections.abc import Callable
from typing import Literal

from evercal.errors import with_options
from evercal.live.coverage import IMAGES
from evercal.recordings.frame import MIN_TRAIN_FRAMES
from evercal.service.studio.studio import Studio

State = tuple[Literal["waits", "to do", "done"], str]
"""Status of a step, and its result or what to do in one to three sentences."""

_NO_FIXED = "No fixed camera was given; restart with `fixed` SOURCE, or go on."
"""What to do in a step that needs a fixed camera."""


def _connect(studio: Studio) -> State:
    if studio.connection.complete:
        return "done", "Images and gripper poses arrive."
    problems = studio.connection.problems.values()
    return "to do", next(iter(problems), "Waiting for image and pose.")


def _record(studio: Studio) -> State:
    covered = studio.coverage()
    if covered.samples:
        if covered.ready:
            return "done", covered.verdict
        return "to do", covered.verdict
    if studio.connection.devices.wrist_camera is None:
        return "waits", "No camera on the gripper was given; go on to 'Hold'."
    if not studio.connection.complete:
        return "waits", "Connect the camera and the robot first."
    return (
        "to do",
        "Move the arm until the camera sees the work area; take the first sample.",
    )


def _learn(studio: Studio) -> State:
    found = studio.calibrations.get("wrist")
    covered = studio.coverage()
    if found is not None and not studio.samples_changed():
        return "done", found.verdict
    if not covered.ready:
        return "waits", "The recording cannot be learned yet."
    if found is not None:
        return "to do", "The samples have changed since: learn them again."
    return "to do", f"{len(covered.samples)} images are ready to be learned."


def _fixed(studio: Studio) -> State:
    images = len(studio.fixed_images)
    found = studio.calibrations.get("fixed")
    if found is not None:
        return "done", with_options(found.verdict).replace(
            "--camera", "--fixed-intrinsics"
        )
    if not studio.cell.scenes:
        return (
            "waits",
            "Learn the scene first, or let the gripper hold something: see 'Hold'.",
        )
    if studio.connection.devices.fixed_camera is None:
        return "waits", _NO_FIXED
    if not images:
        return "to do", "Take images of the scene, 5 to 10."
    return "to do", f"{images} images; take more, or calibrate."


def _hold(studio: Studio) -> State:
    found = studio.calibrations.get("fixed")
    covered = studio.coverage("fixed")
    if found is not None and not studio.samples_changed("fixed"):
        return "done", found.verdict
    if studio.connection.devices.fixed_camera is None:
        return "waits", _NO_FIXED
    if covered.samples:
        return "to do", covered.verdict
    return "to do", (
        "Calibrates the fixed camera without a scene. The gripper holds a textured thing, such as a"
        f" box or a book, and turns it by 20° and more about two axes: {MIN_TRAIN_FRAMES} images"
        f" or more, better {IMAGES}."
    )


def _export(studio: Studio) -> State:
    if not studio.calibrations:
        return "waits", "There is no calibration to export yet."
    exported = len(list((studio.out / "export").glob("*")))
    if exported:
        return "done", f"{exported} files were exported."
    return "to do", "Choose a camera and a format."


STEPS: dict[str, Callable[[Studio], State]] = {
    "Connect": _connect,
    "Record": _record,
    "Learn": _learn,
    "Fixed": _fixed,
    "Hold": _hold,
    "Export": _export,
}
"""All steps in order, each with its state; `Hold` stands in for the three before it."""
