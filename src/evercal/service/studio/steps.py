"""The five steps: which are open, which are done, and what to do next."""

from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from evercal.service.studio.studio import Studio

Step = Literal["connect", "record", "learn", "fixed", "export"]
State = tuple[Literal["locked", "open", "done"], str]
"""Status of a step, and what was found or what to do in one to three sentences."""


def step_states(studio: "Studio") -> dict[Step, State]:
    """All steps in order."""
    return {
        "connect": _connect(studio),
        "record": _record(studio),
        "learn": _learn(studio),
        "fixed": _fixed(studio),
        "export": _export(studio),
    }


def _connect(studio: "Studio") -> State:
    if studio.connection.complete:
        return "done", "Images and gripper poses arrive."
    problems = studio.connection.problems
    return "open", problems.get("wrist") or problems.get("robot") or "Waiting for image and pose."


def _record(studio: "Studio") -> State:
    covered = studio.samples.coverage()
    if covered.samples:
        return "done" if covered.ready else "open", covered.verdict
    if not studio.connection.complete:
        return "locked", "Connect the camera and the robot first."
    return "open", "Move the arm until the camera sees the work area; take the first sample."


def _learn(studio: "Studio") -> State:
    found, covered = studio.calibrations.get("wrist"), studio.samples.coverage()
    if found is not None and not studio.samples_changed:
        return "done", found.verdict
    if not covered.ready:
        return "locked", "The recording cannot be learned yet."
    if found is not None:
        return "open", "The samples have changed since: learn them again."
    return "open", f"{len(covered.samples)} images are ready to be learned."


def _fixed(studio: "Studio") -> State:
    images, found = len(studio.fixed_images), studio.calibrations.get("fixed")
    if not studio.cell.scenes:
        return "locked", "Learn the scene first."
    if found is not None:
        return "done", found.verdict.replace("--camera", "--fixed-intrinsics")
    if studio.connection.devices.fixed_camera is None:
        return "locked", "No fixed camera was given; restart with --fixed SOURCE, or go on."
    if not images:
        return "open", "Take images of the scene, 5 to 10."
    return "open", f"{images} images; take more, or calibrate."


def _export(studio: "Studio") -> State:
    if not studio.calibrations:
        return "locked", "There is no calibration to export yet."
    exported = len(list((studio.out / "export").glob("*")))
    return (
        ("done", f"{exported} files were exported.") if exported else ("open", "Choose a format.")
    )
