"""The five steps: which are open, which are done, and what to do next."""

from dataclasses import dataclass
from typing import Literal

from evercal.live.coverage import Coverage

Step = Literal["connect", "record", "learn", "fixed", "export"]
Status = Literal["locked", "open", "done"]
STEPS: tuple[Step, ...] = ("connect", "record", "learn", "fixed", "export")
TITLES: dict[Step, str] = {
    "connect": "Connect",
    "record": "Record",
    "learn": "Learn",
    "fixed": "Fixed camera",
    "export": "Export",
}


@dataclass(frozen=True, eq=False)
class Facts:
    """What the steps depend on."""

    connected: bool
    """Whether images and poses arrive."""
    connection_problem: str
    """Reason why not."""
    coverage: Coverage
    """Of the samples."""
    mount_verdict: str | None
    """Of the camera on the gripper; None if it is not calibrated."""
    samples_changed: bool
    """Whether samples were added or removed since it was."""
    scenes: int
    """Scenes of the map."""
    has_fixed: bool
    """Whether there is a fixed camera."""
    fixed_images: int
    fixed_verdict: str | None
    """Of the fixed camera; None if it is not calibrated."""
    exported: int
    """Files that were exported."""


@dataclass(frozen=True)
class StepState:
    """A step, and what it says."""

    step: Step
    status: Status
    says: str
    """What was found, or what to do; one to three sentences."""

    @property
    def title(self) -> str:
        """Number and name."""
        return f"{STEPS.index(self.step) + 1} {TITLES[self.step]}"


def step_states(facts: Facts) -> tuple[StepState, ...]:
    """All steps in order."""
    return (_connect(facts), _record(facts), _learn(facts), _fixed(facts), _export(facts))


def current_step(states: tuple[StepState, ...]) -> Step:
    """The first step that is open, or the last one."""
    for state in states:
        if state.status == "open":
            return state.step
    return "export"


def _connect(facts: Facts) -> StepState:
    if facts.connected:
        return StepState("connect", "done", "Images and gripper poses arrive.")
    return StepState("connect", "open", facts.connection_problem or "Waiting for image and pose.")


def _record(facts: Facts) -> StepState:
    covered = facts.coverage
    if not facts.connected and not covered.samples:
        return StepState("record", "locked", "Connect the camera and the robot first.")
    if not covered.samples:
        return StepState(
            "record",
            "open",
            "Move the arm to where the camera sees the work area, and take the first sample.",
        )
    return StepState("record", "done" if covered.ready else "open", covered.verdict)


def _learn(facts: Facts) -> StepState:
    if facts.mount_verdict is not None and not facts.samples_changed:
        return StepState("learn", "done", facts.mount_verdict)
    if not facts.coverage.ready:
        return StepState("learn", "locked", "The recording cannot be learned yet.")
    if facts.mount_verdict is not None:
        return StepState("learn", "open", "The samples have changed since: learn them again.")
    count = len(facts.coverage.samples)
    return StepState("learn", "open", f"{count} images are ready to be learned.")


def _fixed(facts: Facts) -> StepState:
    if not facts.scenes:
        return StepState("fixed", "locked", "Learn the scene first.")
    if facts.fixed_verdict is not None:
        return StepState("fixed", "done", facts.fixed_verdict)
    if not facts.has_fixed:
        says = "No fixed camera was given; start the studio with --fixed SOURCE, or go on."
        return StepState("fixed", "locked", says)
    if not facts.fixed_images:
        return StepState("fixed", "open", "Take images of the scene, 5 to 10.")
    return StepState("fixed", "open", f"{facts.fixed_images} images; take more, or calibrate.")


def _export(facts: Facts) -> StepState:
    if facts.mount_verdict is None and facts.fixed_verdict is None:
        return StepState("export", "locked", "There is no calibration to export yet.")
    if facts.exported:
        return StepState("export", "done", f"{facts.exported} files were exported.")
    return StepState("export", "open", "Choose a camera and a format.")
