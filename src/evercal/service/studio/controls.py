"""The panel beside the scene: a picture, the outcome of tasks, and a tab for each step."""

import logging
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from evercal.calibration.export.formats import FORMATS
from evercal.calibration.from_map.next_views import NextViews
from evercal.errors import InputError
from evercal.live.coverage import POSITION_MM, ROTATION_DEG
from evercal.robot.frame_names import FrameNames
from evercal.service.studio.devices import Which
from evercal.service.studio.steps import STEPS
from evercal.service.studio.studio import FIXED_IMAGES, Studio
from evercal.service.viewer.gate import chosen
from evercal.service.viewer.html import (
    calibration_rows,
    chip_html,
    position_mm,
    rows_html,
)
from evercal.typing import Strings

_CAMERAS: dict[str, Which] = {"camera on the gripper": "wrist", "fixed camera": "fixed"}
"""Cameras by their labels."""


class Tasks:
    """Runs one task at a time in a thread, and calls `changed` when there is something to show."""

    def __init__(self, changed: Callable[[], Any]):
        self._changed = changed
        self._running = threading.Lock()
        self.stop = threading.Event()
        """Asks the running task to stop after its present step."""
        self.message = ""
        self.failed = False
        self.progress = 0.0

    @property
    def busy(self) -> bool:
        """Whether a task runs."""
        return self._running.locked()

    def start(self, what: str, task: Callable[[], str]) -> bool:
        """Run a task, which returns what it did in one line; False if another one runs."""
        if not self._running.acquire(blocking=False):
            return False
        self.stop.clear()
        self.message = what
        self.failed = False
        self.progress = 0.0
        threading.Thread(target=self._run, args=(task,), daemon=True).start()
        return True

    def step(self, what: str, done: float, total: float) -> None:
        """Report progress from inside a task."""
        self.message = what
        self.progress = 0.0
        if total:
            self.progress = min(done / total, 1.0)
        self._changed()

    def _run(self, task: Callable[[], str]) -> None:
        self._changed()
        try:
            self.message = task()
        except (InputError, OSError) as error:
            self.message = " ".join(str(error).split())
            self.failed = True
        except Exception as error:
            logging.getLogger(__name__).exception("a task of the studio failed")
            self.message = f"internal error, {type(error).__name__}: {error}"
            self.failed = True
        self._running.release()
        self._changed()


class Controls:
    """The panel."""

    def __init__(self, server: viser.ViserServer, studio: Studio, tasks: Tasks):
        self._gui = server.gui
        self._studio = studio
        self._tasks = tasks
        self._view: NextViews | None = None
        self._updates: list[Callable[[], None]] = []
        """Calls that bring single controls up to date."""
        gui = self._gui
        cameras = studio.connection.devices.cameras
        labels = [label for label, which in _CAMERAS.items() if which in cameras]
        self._camera = gui.add_dropdown("Camera", labels)
        self._picture = gui.add_image(np.zeros((3, 4, 3), np.uint8))
        self._keep(gui.add_html(""), content=self._message)
        bar = gui.add_progress_bar(0.0, animated=True)
        self._keep(bar, visible=lambda: tasks.busy, value=lambda: 100 * tasks.progress)
        tabs = gui.add_tab_group()
        steps = (
            self._connect,
            self._samples,
            self._learn,
            self._fixed,
            self._hold,
            self._export,
        )
        for (title, state), add in zip(STEPS.items(), steps, strict=True):
            with tabs.add_tab(title):
                self._keep(
                    gui.add_html(""),
                    content=lambda state=state: chip_html(*state(studio)),
                )
                add()

    @property
    def which(self) -> Which:
        """The camera whose picture is shown."""
        return _CAMERAS[chosen(self._camera)]

    def show(self, next_view: NextViews | None) -> None:
        """Show the state of the steps and of the task that runs."""
        self._view = next_view
        for update in self._updates:
            update()

    def show_live(self) -> None:
        """Show what arrives from the chosen camera and the robot."""
        connection = self._studio.connection
        if self.which in connection.images:
            self._picture.image = connection.images[self.which]
        rows = [(f"{name}: no data", why) for name, why in connection.problems.items()]
        if connection.base_from_gripper is not None:
            rows.append(("gripper", position_mm(connection.base_from_gripper)))
        self._arrives.content = rows_html(rows)

    def _connect(self) -> None:
        self._arrives = self._gui.add_html("")

    def _samples(self, which: Which = "wrist") -> None:
        studio = self._studio
        gui = self._gui
        tasks = self._tasks
        take, move = ("T", "M") if which == "wrist" else (None, None)
        self._button("Take sample", lambda: studio.take_sample(which), take)
        if studio.can_move:
            self._button("Move there", lambda: studio.move_on(which), move)
            self._button(
                "Record by itself",
                lambda: studio.record(tasks.step, tasks.stop.is_set, which),
            )
            gui.add_button("Stop", color="red").on_click(lambda _: tasks.stop.set())
        self._keep(gui.add_html(""), content=lambda: self._coverage(which))
        sample: Any = gui.add_dropdown("Sample", ("-",))

        def names() -> Strings:
            frames = reversed(studio.recorders[which].frames)
            return tuple(frame.name for frame in frames)

        def show_names() -> None:
            shown = names() or ("-",)
            if shown != sample.options:
                sample.options = shown
                sample.value = shown[0]  # the one taken last

        self._updates.append(show_names)
        self._button("Remove", lambda: studio.remove(sample.value, which=which))
        self._button(
            "Remove the bad ones",
            lambda: studio.remove(*studio.bad_samples(which), which=which),
        )
        self._button("Remove all", lambda: studio.remove(*names(), which=which))

    def _learn(self) -> None:
        self._button(
            "Learn the recording", lambda: self._studio.learn(self._tasks.step)
        )
        self._keep(self._gui.add_html(""), content=lambda: self._numbers("wrist"))

    def _fixed(self) -> None:
        studio = self._studio
        gui = self._gui
        step = self._tasks.step
        moves = studio.can_move
        move = gui.add_checkbox("Move the arm between images", moves, visible=moves)

        def images() -> str:
            return rows_html([("images", str(len(studio.fixed_images)))])

        series = f"Take {FIXED_IMAGES} images"
        self._button("Take image", studio.take_fixed)
        self._button(series, lambda: studio.take_fixed_series(step, move.value))
        self._button("Calibrate", lambda: studio.calibrate_fixed(step))
        self._button("Check", studio.check_fixed)
        self._button("Remove all images", studio.clear_fixed)
        self._keep(gui.add_html(""), content=lambda: images() + self._numbers("fixed"))

    def _hold(self) -> None:
        studio = self._studio
        self._samples("fixed")
        self._button("Calibrate", lambda: studio.learn(self._tasks.step, "fixed"))
        self._keep(self._gui.add_html(""), content=lambda: self._numbers("fixed"))

    def _export(self) -> None:
        camera = self._gui.add_dropdown("Calibration", tuple(_CAMERAS))
        format = self._gui.add_dropdown("Format", tuple(FORMATS))
        fields = [
            self._gui.add_text(f"{role} frame", "")
            for role in ("Base", "Gripper", "Camera")
        ]
        camera.on_update(lambda _: setattr(fields[2], "value", ""))

        def export() -> str:
            names = FrameNames(*(field.value.strip() for field in fields))
            return self._studio.export(_CAMERAS[chosen(camera)], chosen(format), names)

        self._button("Export file", export)

    def _keep(self, handle: Any, **properties: Callable[[], Any]) -> None:
        def update() -> None:
            for name, value in properties.items():
                setattr(handle, name, value())

        self._updates.append(update)

    def _button(self, label: str, task: Callable[[], str], key: Any = None) -> None:
        def start(_: object) -> None:
            self._tasks.start(f"{label.lower()} ...", task)

        button = self._gui.add_button(label, hint=key and f"Key {key}")
        button.on_click(start)
        self._keep(button, disabled=lambda: self._tasks.busy)
        if key is not None:
            self._gui.add_command(label, hotkey=key).on_trigger(start)

    def _message(self) -> str:
        tasks = self._tasks
        if not tasks.message:
            return ""
        state = "done"
        if tasks.failed:
            state = "failed"
        elif tasks.busy:
            state = "working"
        return chip_html(state, tasks.message)

    def _coverage(self, which: Which) -> str:
        covered = self._studio.coverage(which)
        rows = []
        axes = [(axis, "°", ROTATION_DEG) for axis in covered.rotations]
        axes += [(axis, " mm", POSITION_MM) for axis in covered.positions]
        for axis, unit, wanted in axes:
            enough = "✓" if axis.covered else f"of {wanted:.0f}{unit}"
            rows.append((axis.name, f"{axis.spread:.0f}{unit} {enough}"))
        if which == "wrist" and self._view is not None:
            place = position_mm(self._view.poses[0], digits=0)
            now, then = self._view.sigma_mm[:2]
            rows.append(("next view (amber)", f"gripper at {place}"))
            rows.append(("expected 1 sigma", f"{now:.3f} mm → {then:.3f} mm"))
        for row in covered.samples:
            if row.problems:
                rows.append((row.name, "; ".join(row.problems)))
        return rows_html(rows)

    def _numbers(self, which: Which) -> str:
        calibration = self._studio.calibrations.get(which)
        if calibration is None:
            return ""
        file = str(self._studio.calibration_file(which))
        return rows_html([*calibration_rows(calibration), ("file", file)])
