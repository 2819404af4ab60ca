"""The panel beside the scene: a picture, the outcome of tasks, and a tab for each step."""

import logging
import threading
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import viser

from evercal.calibration.export.formats import FORMATS
from evercal.calibration.from_map.next_views import NextViews
from evercal.errors import InputError
from evercal.live.coverage import POSITION_MM, ROTATION_DEG
from evercal.reports.overlay import resized
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
_PICTURE_PX = 480
"""Width of the pictures."""


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
        self._pictures: list[tuple[Which, viser.GuiImageHandle]] = []
        gui = self._gui
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

    def show(self, next_view: NextViews | None) -> None:
        """Show the state of the steps and of the task that runs."""
        self._view = next_view
        for update in self._updates:
            update()

    def show_live(self) -> None:
        """Show what arrives from cameras and robot."""
        connection = self._studio.connection
        for which, picture in self._pictures:
            if which in connection.images:
                picture.image = resized(connection.images[which], _PICTURE_PX)
                picture.visible = True
        rows = [(f"{name}: no data", why) for name, why in connection.problems.items()]
        if connection.base_from_gripper is not None:
            rows.append(("gripper", position_mm(connection.base_from_gripper)))
        self._arrives.content = rows_html(rows)

    def _picture(self, which: Which) -> None:
        nothing = np.zeros((3, 4, 3), np.uint8)
        picture = self._gui.add_image(nothing, visible=False)
        self._pictures.append((which, picture))

    def _connect(self) -> None:
        self._arrives = self._gui.add_html("")
        for which in _CAMERAS.values():
            self._picture(which)

    def _samples(self, which: Which = "wrist") -> None:
        studio = self._studio
        gui = self._gui
        tasks = self._tasks
        take, move = ("T", "M") if which == "wrist" else (None, None)

        def few() -> bool:
            return not studio.coverage(which).ready

        def by_hand() -> bool:
            return few() and not studio.can_move

        self._picture(which)
        if studio.can_move:
            self._button(
                "Record by itself",
                lambda: studio.record(tasks.step, tasks.stop.is_set, which),
                first=few,
            )
            stop = gui.add_button("Stop", color="red")
            stop.on_click(lambda _: tasks.stop.set())
            self._keep(stop, disabled=lambda: not tasks.busy)
            self._button("Move there", lambda: studio.move_on(which), move)
        take_sample = partial(studio.take_sample, which)
        self._button("Take sample", take_sample, take, first=by_hand)
        if which == "fixed":
            learn = partial(studio.learn, tasks.step, which)
            self._button("Calibrate", learn, first=lambda: not few())
        self._keep(gui.add_html(""), content=lambda: self._coverage(which))
        with gui.add_folder("Samples", expand_by_default=False):
            self._removal(which)

    def _removal(self, which: Which) -> None:
        studio = self._studio
        sample: Any = self._gui.add_dropdown("Sample", ("-",))

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
        learn = partial(self._studio.learn, self._tasks.step)
        self._button("Learn the recording", learn, first=self._studio.samples_changed)
        self._keep(self._gui.add_html(""), content=lambda: self._numbers("wrist"))

    def _fixed(self) -> None:
        studio = self._studio
        gui = self._gui
        step = self._tasks.step
        self._picture("fixed")
        moves = studio.can_move
        move = gui.add_checkbox("Move the arm between images", moves, visible=moves)

        def images() -> str:
            return rows_html([("images", str(len(studio.fixed_images)))])

        self._button(
            f"Take {FIXED_IMAGES} images",
            lambda: studio.take_fixed_series(step, move.value),
            first=lambda: not studio.fixed_images,
        )
        self._button("Take image", studio.take_fixed)
        calibrate = partial(studio.calibrate_fixed, step)
        self._button("Calibrate", calibrate, first=lambda: bool(studio.fixed_images))
        self._button("Check", studio.check_fixed)
        self._keep(gui.add_html(""), content=lambda: images() + self._numbers("fixed"))
        self._button("Remove all images", studio.clear_fixed)

    def _hold(self) -> None:
        self._samples("fixed")
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

        self._button("Export file", export, first=lambda: True)

    def _keep(self, handle: Any, **properties: Callable[[], Any]) -> None:
        def update() -> None:
            for name, value in properties.items():
                setattr(handle, name, value())

        self._updates.append(update)

    def _button(
        self,
        label: str,
        task: Callable[[], str],
        key: Any = None,
        first: Callable[[], bool] = bool,
    ) -> None:
        """A grey button; `first` says when it is the one that leads on."""

        def start(_: object) -> None:
            self._tasks.start(f"{label.lower()} ...", task)

        button = self._gui.add_button(label, hint=key and f"Key {key}")
        button.on_click(start)
        self._keep(
            button,
            disabled=lambda: self._tasks.busy,
            color=lambda: None if first() else "gray",
        )
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
