"""The panels of the steps Connect and Record."""

from collections.abc import Callable
from typing import Any

import viser

from evercal.live.coverage import Coverage, CoverageOptions
from evercal.service.studio.book import Proposal
from evercal.service.studio.devices import Seen
from evercal.service.studio.html import (
    command_html,
    coverage_html,
    samples_html,
    seen_html,
    step_html,
    thumbnail_url,
)
from evercal.service.studio.jobs import Jobs, Task
from evercal.service.studio.steps import StepState
from evercal.service.studio.studio import Studio
from evercal.service.viewer.answers import AMBER
from evercal.service.viewer.text import rows_html

NO_SAMPLE = "-"


class Panel:
    """The controls of one step, below its title and status.

    Args:
        gui: controls of the page.
        studio: what is done.
        jobs: where tasks run.
    """

    def __init__(self, gui: viser.GuiApi, studio: Studio, jobs: Jobs):
        self._studio, self._jobs = studio, jobs
        self.folder = gui.add_folder(None)
        with self.folder:
            self._says = gui.add_html("")
            self._add(gui)

    def show(self, state: StepState, busy: bool) -> None:
        """Show the state; controls are disabled while a task runs."""
        self._says.content = step_html(state)
        self._update(state, busy)

    def _add(self, gui: viser.GuiApi) -> None:
        """Add the controls."""
        raise NotImplementedError

    def _update(self, state: StepState, busy: bool) -> None:
        """Show what has changed."""

    def _runs(self, button: viser.GuiButtonHandle, what: str, task: Task) -> None:
        """Run a task when a button is clicked."""
        on_click(button, lambda: self._jobs.start(what, task))


class ConnectPanel(Panel):
    """What arrives from camera and robot.

    Args:
        gui: controls of the page.
        studio: what is connected.
        jobs: where tasks run.
        command: the command that started the studio.
    """

    def __init__(self, gui: viser.GuiApi, studio: Studio, jobs: Jobs, command: str):
        self._command = command
        super().__init__(gui, studio, jobs)

    def _add(self, gui: viser.GuiApi) -> None:
        self._seen = gui.add_html("")
        gui.add_html(command_html(self._command))

    def show_seen(self, seen: Seen) -> None:
        """Show what has arrived."""
        self._seen.content = seen_html(seen)


class RecordPanel(Panel):
    """Samples, what they cover, and where to go next."""

    def __init__(self, gui: viser.GuiApi, studio: Studio, jobs: Jobs):
        self._thumbnails: dict[str, str] = {}
        self._proposal: Proposal | None = None
        super().__init__(gui, studio, jobs)
        self._connect()

    def _add(self, gui: viser.GuiApi) -> None:
        moves = self._studio.devices.can_move
        self._take = gui.add_button("Take sample", icon=viser.Icon.CAMERA, hint="Key T")
        self._move = gui.add_button(
            "Move there", color=AMBER, visible=moves, hint="Moves the arm. Key M"
        )
        self._record = gui.add_button(
            "Record by itself", color="gray", visible=moves, hint="Until complete"
        )
        self.auto = gui.add_checkbox(
            "Sample when still", False, hint="Take a sample whenever the arm comes to rest"
        )
        self._next = gui.add_html("")
        self._coverage = gui.add_html("")
        self._list = gui.add_html("")
        names: list[str] = [NO_SAMPLE]
        self._sample = gui.add_dropdown("Sample", names)
        self._remove = gui.add_button("Remove", color="gray")
        self._remove_bad = gui.add_button("Remove the bad ones", color="gray")
        gui.add_html(command_html(self._studio.folders.record_command()))

    @property
    def proposal(self) -> Proposal | None:
        """The next view that is shown."""
        return self._proposal

    def take(self) -> None:
        """Take a sample."""
        self._jobs.start("taking a sample", self._studio.take_sample)

    def move(self) -> None:
        """Move the arm to the next view."""
        proposal = self._proposal
        if proposal is not None and self._studio.devices.can_move:
            pose = proposal.base_from_gripper
            self._jobs.start("the arm moves", lambda: self._studio.move_to(pose))

    def choose(self, name: str) -> None:
        """Choose a sample in the list."""
        if name in self._sample.options:
            self._sample.value = name

    def _update(self, state: StepState, busy: bool) -> None:
        has_samples = bool(self._studio.book.frames)
        self._take.disabled = self._record.disabled = busy
        self._move.disabled = busy or self._proposal is None
        self._remove.disabled = self._remove_bad.disabled = busy or not has_samples

    def show_samples(self, covered: Coverage, proposal: Proposal | None) -> None:
        """Show changed samples."""
        self._proposal, options = proposal, CoverageOptions()
        for frame in self._studio.book.frames:
            if frame.name not in self._thumbnails:
                self._thumbnails[frame.name] = thumbnail_url(frame.read_image())
        limits = options.rotation_deg, options.position_mm
        self._coverage.content = coverage_html(covered, limits) if covered.samples else ""
        self._list.content = samples_html(covered, self._thumbnails)
        names = tuple(reversed(self._studio.book.names)) or (NO_SAMPLE,)
        self._sample.options = list(names)
        self._sample.value = names[0]  # the one that was taken last
        self._next.content = rows_html(_proposal_rows(proposal))

    def _connect(self) -> None:
        studio, jobs = self._studio, self._jobs

        def record() -> str:
            return studio.record(jobs.step, lambda: jobs.stopping)

        def remove() -> None:
            name = self._sample.value
            if name != NO_SAMPLE:
                jobs.start("removing", lambda: studio.remove(name))

        on_click(self._take, self.take)
        on_click(self._move, self.move)
        self._runs(self._record, "recording", record)
        on_click(self._remove, remove)
        self._runs(self._remove_bad, "removing", lambda: studio.remove(*studio.book.bad()))


def on_click(button: viser.GuiButtonHandle, action: Callable[[], Any]) -> None:
    """Call a function without arguments when a button is clicked."""

    def clicked(_: viser.GuiEvent[Any]) -> None:
        action()

    button.on_click(clicked)


def _proposal_rows(proposal: Proposal | None) -> list[tuple[str, str]]:
    if proposal is None:
        return []
    x, y, z = 1000 * proposal.base_from_gripper.translation_m
    (now, then), (now_deg, then_deg) = proposal.sigma_mm, proposal.sigma_deg
    return [
        ("next view, gripper", f"{x:+.0f} {y:+.0f} {z:+.0f} mm (amber camera)"),
        ("expected 1 sigma", f"{now:.3f} mm, {now_deg:.3f}° → {then:.3f} mm, {then_deg:.3f}°"),
    ]
