"""The panels of the steps Learn, Fixed camera and Export."""

import viser

from evercal.calibration.export.formats import FORMATS
from evercal.geometry import Camera
from evercal.service.studio.devices import Which
from evercal.service.studio.html import command_html
from evercal.service.studio.panels import Panel
from evercal.service.studio.steps import StepState
from evercal.service.studio.studio import FIXED_IMAGES, Studio
from evercal.service.viewer.calibrations import CalibrationView
from evercal.service.viewer.text import rows_html

_NAMES: dict[str, Which] = {"camera on the gripper": "wrist", "fixed camera": "fixed"}


class LearnPanel(Panel):
    """Learning, and the mount of the camera."""

    def _add(self, gui: viser.GuiApi) -> None:
        self._learn = gui.add_button("Learn the recording", icon=viser.Icon.BRAIN)
        self._rows = gui.add_html("")
        self._command = gui.add_html("")
        self._runs(self._learn, "learning", lambda: self._studio.learn(self._jobs.step))

    def _update(self, state: StepState, busy: bool) -> None:
        studio = self._studio
        self._learn.disabled = busy or state.status == "locked"
        self._learn.label = "Learn again" if state.status == "done" else "Learn the recording"
        self._rows.content = rows_html(_rows(studio, "wrist"))
        self._command.content = command_html(studio.folders.learn_command(studio.scene))


class FixedPanel(Panel):
    """Images, calibration and check of the fixed camera."""

    def _add(self, gui: viser.GuiApi) -> None:
        studio, step = self._studio, self._jobs.step
        moves = studio.devices.can_move
        self._take = gui.add_button("Take image", icon=viser.Icon.CAMERA)
        self._series = gui.add_button(f"Take {FIXED_IMAGES} images")
        move = gui.add_checkbox(
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
            return studio.take_fixed_series(step, bool(move.value and moves))

        self._runs(self._take, "taking an image", studio.take_fixed)
        self._runs(self._series, "taking images", series)
        self._runs(self._calibrate, "calibrating", lambda: studio.calibrate_fixed(step))
        self._runs(self._check, "checking", studio.check_fixed)
        self._runs(self._clear, "removing", clear)

    def _update(self, state: StepState, busy: bool) -> None:
        studio = self._studio
        images = len(studio.fixed.files)
        absent = studio.devices.fixed_camera is None
        self._take.disabled = self._series.disabled = busy or absent
        self._calibrate.disabled = busy or not images or not studio.cell.scenes
        self._check.disabled = busy or absent or "fixed" not in studio.calibrations
        self._clear.disabled = busy or not images
        self._rows.content = rows_html([("images", str(images)), *_rows(studio, "fixed")])


class ExportPanel(Panel):
    """Exports and reports."""

    def _add(self, gui: viser.GuiApi) -> None:
        self._which = gui.add_dropdown("Camera", tuple(_NAMES))
        self._format = gui.add_dropdown("Format", tuple(FORMATS))
        self._about = gui.add_html("")
        self._export = gui.add_button("Export file", icon=viser.Icon.FILE_EXPORT)
        self._report = gui.add_button("Write report")
        self._command = gui.add_html("")
        for choice in (self._which, self._format):
            choice.on_update(lambda _: self._show_command())

        def export() -> str:
            return self._studio.export(_NAMES[self._which.value], self._format.value)

        def report() -> str:
            return self._studio.report(_NAMES[self._which.value])

        self._runs(self._export, "exporting", export)
        self._runs(self._report, "writing the report", report)

    def _update(self, state: StepState, busy: bool) -> None:
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
