"""The panel beside the scene: what all steps share, and a folder for each step."""

from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from evercal.calibration.export.formats import FORMATS
from evercal.calibration.next_views import NextViews
from evercal.live.coverage import CoverageOptions
from evercal.service.studio.devices import Which
from evercal.service.studio.steps import Step, step_states
from evercal.service.studio.studio import FIXED_IMAGES, Studio
from evercal.service.studio.tasks import Tasks
from evercal.service.viewer.calibrations import calibration_rows
from evercal.service.viewer.html import BLUE, GREEN, GREY, RED, chip_html, rows_html

TITLES: dict[Step, str] = {
    "connect": "Connect",
    "record": "Record",
    "learn": "Learn",
    "fixed": "Fixed camera",
    "export": "Export",
}
_STATUS = {"locked": ("waits", GREY), "open": ("to do", BLUE), "done": ("done", GREEN)}
_CAMERAS: dict[str, Which] = {"camera on the gripper": "wrist", "fixed camera": "fixed"}


class Controls:
    """The panel; `refresh` shows all of the page again."""

    def __init__(
        self,
        server: viser.ViserServer,
        studio: Studio,
        tasks: Tasks,
        refresh: Callable[[], Any],
    ):
        self._gui, self._studio, self._tasks, self._refresh = server.gui, studio, tasks, refresh
        self.step: Step = "connect"
        self._view: NextViews | None = None
        self._shown: list[Callable[[], None]] = []
        """Calls that bring single controls up to date."""
        gui = self._gui
        gui.main_panel.dock_right()
        steps = gui.add_button_group("Step", [str(i + 1) for i in range(len(TITLES))])
        steps.on_click(lambda _: self.go(tuple(TITLES)[int(steps.value) - 1]))
        self._add_state()
        self._picture = gui.add_image(np.zeros((3, 4, 3), np.uint8))
        add = (self._connect, self._record, self._learn, self._fixed, self._export)
        for step, contents in zip(TITLES, add, strict=True):
            folder = gui.add_folder(None)
            self._keep(folder, visible=lambda step=step: self.step == step)
            with folder:
                contents()

    def go(self, step: Step) -> None:
        """Show a step."""
        self.step = step
        self._refresh()

    def choose(self, name: str) -> None:
        """Choose a sample in the list."""
        self._sample.value = name

    def show(self, next_view: NextViews | None) -> None:
        """Show the state of the step and of the task that runs."""
        self._view = next_view
        for update in self._shown:
            update()

    def show_live(self, which: Which) -> None:
        """Show what arrives from a camera and the robot."""
        connection = self._studio.connection
        if which in connection.images:
            self._picture.image = connection.images[which]
        rows = [(f"{name}: no data", problem) for name, problem in connection.problems.items()]
        if connection.base_from_gripper is not None:
            x, y, z = 1000 * connection.base_from_gripper.translation_m
            rows.append(("gripper", f"{x:+.1f} {y:+.1f} {z:+.1f} mm"))
            rows.append(("arm", "stands still" if connection.rests(1.0) else "moves"))
        self._arrives.content = rows_html(rows)

    def _add_state(self) -> None:
        gui, studio, tasks = self._gui, self._studio, self._tasks

        def state() -> str:
            status, says = step_states(studio)[self.step]
            words, colour = _STATUS[status]
            number = tuple(TITLES).index(self.step) + 1
            return chip_html(f"{number} {TITLES[self.step]}: {words}", colour, says)

        def message() -> str:
            kind = "failed" if tasks.failed else "working" if tasks.busy else "done"
            colour = {"failed": RED, "working": BLUE, "done": GREEN}[kind]
            return chip_html(kind, colour, tasks.message) if tasks.message else ""

        self._keep(gui.add_html(""), content=state)
        self._keep(gui.add_html(""), content=message)
        bar = gui.add_progress_bar(0.0, animated=True)
        self._keep(bar, visible=lambda: tasks.busy, value=lambda: 100 * tasks.progress)
        stop = gui.add_button("Stop", color="red")
        stop.on_click(lambda _: tasks.stop.set())
        self._keep(stop, visible=lambda: tasks.busy and self.step == "record")
        following = gui.add_button("Next step", color="teal", icon=viser.Icon.ARROW_RIGHT)
        following.on_click(lambda _: self.go(self._following()))
        self._keep(following, label=lambda: f"Next: {TITLES[self._following()]}")

    def _following(self) -> Step:
        steps = tuple(TITLES)
        return steps[(steps.index(self.step) + 1) % len(steps)]

    def _connect(self) -> None:
        self._arrives = self._gui.add_html("")

    def _record(self) -> None:
        studio, gui, tasks = self._studio, self._gui, self._tasks
        self._button("Take sample", studio.take_sample, key="T")
        if studio.can_move:
            self._button("Move there", self._move, lambda: self._view is not None, key="M")
            self._button("Record by itself", lambda: studio.record(tasks.step, tasks.stop.is_set))
        self.auto = gui.add_checkbox("Sample when still", False)
        self._keep(gui.add_html(""), content=self._coverage)
        self._sample = gui.add_dropdown("Sample", ("-",))
        self._keep(self._sample, options=lambda: tuple(reversed(studio.samples.names)) or ("-",))
        self._button(
            "Remove", lambda: studio.remove(self._sample.value), lambda: bool(studio.samples.names)
        )
        self._button("Remove the bad ones", lambda: studio.remove(*studio.samples.bad()))

    def _learn(self) -> None:
        studio, step = self._studio, self._tasks.step
        self._button(
            "Learn the recording",
            lambda: studio.learn(step),
            lambda: step_states(studio)["learn"][0] != "locked",
        )
        self._keep(self._gui.add_html(""), content=lambda: self._numbers("wrist"))

    def _fixed(self) -> None:
        studio, gui, step = self._studio, self._gui, self._tasks.step
        moves = studio.can_move
        move = gui.add_checkbox("Move the arm between images", moves, visible=moves)
        series = f"Take {FIXED_IMAGES} images"
        self._button("Take image", studio.take_fixed)
        self._button(series, lambda: studio.take_fixed_series(step, moves and move.value))
        self._button(
            "Calibrate", lambda: studio.calibrate_fixed(step), lambda: bool(studio.cell.scenes)
        )
        self._button("Check", studio.check_fixed, lambda: "fixed" in studio.calibrations)
        self._button("Remove all images", studio.clear_fixed, lambda: bool(studio.fixed_images))
        self._keep(gui.add_html(""), content=lambda: self._numbers("fixed"))

    def _export(self) -> None:
        studio, gui = self._studio, self._gui
        camera = gui.add_dropdown("Camera", tuple(_CAMERAS))
        format = gui.add_dropdown("Format", tuple(FORMATS))
        about = gui.add_html("")
        self._button(
            "Export file",
            lambda: studio.export(_CAMERAS[camera.value], format.value),
            lambda: bool(studio.calibrations),
        )
        self._keep(
            about, content=lambda: rows_html([("format", FORMATS[format.value].description)])
        )
        format.on_update(lambda _: self._refresh())

    def _keep(self, handle: Any, **properties: Callable[[], Any]) -> None:
        """Set properties of a control whenever something changes."""

        def update() -> None:
            for name, value in properties.items():
                setattr(handle, name, value())

        self._shown.append(update)

    def _button(
        self,
        label: str,
        task: Callable[[], str],
        possible: Callable[[], bool] = lambda: True,
        key: Any = None,
    ) -> None:
        """Add a button, and a key, that runs a task; it is disabled while one runs."""

        def start(_: object) -> None:
            self._tasks.start(f"{label} ...", task)

        button = self._gui.add_button(label, hint=key and f"Key {key}")
        button.on_click(start)
        self._keep(button, disabled=lambda: self._tasks.busy or not possible())
        if key is not None:
            self._gui.add_command(label, hotkey=key).on_trigger(start)

    def _move(self) -> str:
        if self._view is None:
            return "There is no next view."
        return self._studio.move_to(self._view.poses[0])

    def _coverage(self) -> str:
        """Spread of the good samples, the next view, and the bad samples."""
        covered, options, rows = self._studio.samples.coverage(), CoverageOptions(), []
        axes = [(axis, "°", options.rotation_deg) for axis in covered.rotations]
        axes += [(axis, " mm", options.position_mm) for axis in covered.positions]
        for axis, unit, wanted in axes:
            enough = "✓" if axis.covered else f"of {wanted:.0f}{unit}"
            rows.append((axis.name, f"{axis.spread:.0f}{unit} {enough}"))
        if self._view is not None:
            x, y, z = 1000 * self._view.poses[0].translation_m
            now, then = self._view.sigma_mm[:2]
            rows.append(("next view (amber)", f"gripper at {x:+.0f} {y:+.0f} {z:+.0f} mm"))
            rows.append(("expected 1 sigma", f"{now:.3f} mm → {then:.3f} mm"))
        bad = [(row.name, "; ".join(row.problems)) for row in covered.samples if row.problems]
        return rows_html(rows + bad)

    def _numbers(self, which: Which) -> str:
        """Images and calibration of a camera, as far as there are any."""
        found, rows = self._studio.calibrations.get(which), []
        if which == "fixed":
            rows.append(("images", str(len(self._studio.fixed_images))))
        if found is not None:
            rows += [*calibration_rows(found), ("file", str(self._studio.calibration_file(which)))]
        return rows_html(rows)
