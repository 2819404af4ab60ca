"""The panels of the steps Learn, Fixed camera and Export."""

from collections.abc import Callable

import viser

from evercal.calibration.export.formats import FORMATS
from evercal.geometry import Camera
from evercal.service.studio.devices import Which
from evercal.service.studio.html import command_html, rows_html, step_html
from evercal.service.studio.jobs import Jobs
from evercal.service.studio.panels import on_click
from evercal.service.studio.steps import StepState
from evercal.service.studio.studio import FIXED_IMAGES, Studio
from evercal.service.viewer.calibrations import CalibrationView

_NAMES: dict[str, Which] = {"camera on the gripper": "wrist", "fixed camera": "fixed"}


class LearnPanel:
    """Learning, and the mount of the camera.

    Args:
        gui: controls of the page.
        studio: what learns.
        jobs: where tasks run.
    """

    def __init__(self, gui: viser.GuiApi, studio: Studio, jobs: Jobs):
        self._studio = studio
        self.folder = gui.add_folder(None)
        with self.folder:
            self._says = gui.add_html("")
            self._learn = gui.add_button("Learn the recording", icon=viser.Icon.BRAIN)
            self._rows = gui.add_html("")
            self._command = gui.add_html("")
        on_click(self._learn, lambda: jobs.start("learning", lambda: studio.learn(jobs.step)))

    def show(self, state: StepState, busy: bool) -> None:
        """Show the mount."""
        studio = self._studio
        self._says.content = step_html(state)
        self._learn.disabled = busy or state.status == "locked"
        self._learn.label = "Learn again" if state.status == "done" else "Learn the recording"
        self._rows.content = rows_html(_rows(studio, "wrist"))
        self._command.content = command_html(studio.folders.learn_command(studio.scene))


class FixedPanel:
    """Images, calibration and check of the fixed camera.

    Args:
        gui: controls of the page.
        studio: what calibrates.
        jobs: where tasks run.
    """

    def __init__(self, gui: viser.GuiApi, studio: Studio, jobs: Jobs):
        self._studio = studio
        self.folder = gui.add_folder(None)
        moves = studio.devices.can_move
        with self.folder:
            self._says = gui.add_html("")
            self._take = gui.add_button("Take image", icon=viser.Icon.CAMERA)
            self._series = gui.add_button(f"Take {FIXED_IMAGES} images")
            self._move = gui.add_checkbox(
                "Move the arm", moves, visible=moves, hint="to poses of samples between the images"
            )
            self._calibrate = gui.add_button("Calibrate")
            self._check = gui.add_button("Check", hint="Has the camera moved since?")
            self._clear = gui.add_button("Remove all images", color="gray")
            self._rows = gui.add_html("")
            folders = studio.folders
            gui.add_html(command_html(folders.fixed_command(), folders.check_command()))

        def clear() -> str:
            studio.fixed.clear()
            return "Removed all images."

        def series() -> str:
            return studio.take_fixed_series(jobs.step, bool(self._move.value and moves))

        tasks: tuple[tuple[viser.GuiButtonHandle, str, Callable[[], str]], ...] = (
            (self._take, "taking an image", studio.take_fixed),
            (self._series, "taking images", series),
            (self._calibrate, "calibrating", lambda: studio.calibrate_fixed(jobs.step)),
            (self._check, "checking", studio.check_fixed),
            (self._clear, "removing", clear),
        )
        for button, what, task in tasks:
            on_click(button, lambda what=what, task=task: jobs.start(what, task))

    def show(self, state: StepState, busy: bool) -> None:
        """Show images and calibration."""
        studio = self._studio
        images = len(studio.fixed.files)
        absent = studio.devices.fixed_camera is None
        self._says.content = step_html(state)
        self._take.disabled = self._series.disabled = busy or absent
        self._calibrate.disabled = busy or not images or not studio.cell.scenes
        self._check.disabled = busy or absent or "fixed" not in studio.calibrations
        self._clear.disabled = busy or not images
        self._rows.content = rows_html([("images", str(images)), *_rows(studio, "fixed")])


class ExportPanel:
    """Exports and reports.

    Args:
        gui: controls of the page.
        studio: what exports.
        jobs: where tasks run.
    """

    def __init__(self, gui: viser.GuiApi, studio: Studio, jobs: Jobs):
        self._studio = studio
        self.folder = gui.add_folder(None)
        with self.folder:
            self._says = gui.add_html("")
            self._which = gui.add_dropdown("Camera", tuple(_NAMES))
            self._format = gui.add_dropdown("Format", tuple(FORMATS))
            self._about = gui.add_html("")
            self._export = gui.add_button("Export file", icon=viser.Icon.FILE_EXPORT)
            self._report = gui.add_button("Write report")
            self._command = gui.add_html("")
        for choice in (self._which, self._format):
            choice.on_update(lambda _: self._show_command())

        def export() -> str:
            return studio.export(_NAMES[self._which.value], self._format.value)

        on_click(self._export, lambda: jobs.start("exporting", export))
        on_click(
            self._report,
            lambda: jobs.start(
                "writing the report", lambda: studio.report(_NAMES[self._which.value])
            ),
        )

    def show(self, state: StepState, busy: bool) -> None:
        """Show what can be exported."""
        self._says.content = step_html(state)
        self._export.disabled = self._report.disabled = busy or state.status == "locked"
        self._show_command()

    def _show_command(self) -> None:
        which, name = _NAMES[self._which.value], self._format.value
        folders = self._studio.folders
        self._about.content = rows_html(
            [("format", FORMATS[name].description), ("file", str(folders.export(which, name)))]
        )
        self._command.content = command_html(
            folders.export_command(which, name), folders.report_command(which)
        )


def _rows(studio: Studio, which: Which) -> list[tuple[str, str]]:
    """Numbers of a calibration, if there is one."""
    found = studio.calibrations.get(which)
    if found is None:
        return []
    camera: Camera = found.camera or studio.devices.intrinsics
    rows = CalibrationView(which, found, camera).rows()
    file = str(studio.folders.calibration(which))
    return [*(row for row in rows if row[0] != "drawn"), ("file", file)]
