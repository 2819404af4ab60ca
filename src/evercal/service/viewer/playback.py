"""The frames of a recording, one after another: located in the map when the slider stops."""

import threading
from collections.abc import Callable
from typing import Any

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.localization.localizer import Localizer
from evercal.recordings.frame import Frame, Recording
from evercal.service.viewer.answer_panel import AnswerPanel
from evercal.service.viewer.answers import LocatedImage
from evercal.service.viewer.stage import Stage

_PLAY_S = 0.2
"""Shortest time that a frame is shown."""


def stated_pose(frame: Frame, gripper_from_camera: SE3 | None) -> tuple[SE3 | None, str]:
    """The camera pose that an estimate is compared with, and where it comes from.

    That of the recording; without one, the gripper's pose and a calibration of the camera on it.
    """
    if frame.base_from_camera is not None:
        return frame.base_from_camera, "stated pose"
    if frame.base_from_gripper is not None and gripper_from_camera is not None:
        return frame.base_from_gripper @ gripper_from_camera, "gripper pose and calibration"
    return None, "stated pose"


class Playback:
    """The folder "Recording".

    Args:
        stage: The scene.
        recording: Frames; those to learn from come first.
        localizer: The map.
        gripper_from_camera: For recordings that state gripper poses only.
        follow: Called with the scene of an answer.
        on_frame: Called with each frame that is shown.
    """

    def __init__(
        self,
        stage: Stage,
        recording: Recording,
        localizer: Localizer,
        gripper_from_camera: SE3 | None,
        follow: Callable[[str | None], Any],
        on_frame: Callable[[Frame], Any],
    ):
        self.frames = (*recording.train, *recording.test)
        self._localizer, self._on_frame = localizer, on_frame
        self._gripper_from_camera = gripper_from_camera
        self._wake, self._closed = threading.Event(), threading.Event()
        self._server, gui = stage.server, stage.server.gui
        with gui.add_folder("Recording"):
            self._slider = gui.add_slider("Frame", 0, max(len(self.frames) - 1, 1), 1, 0)
            self._play = gui.add_checkbox("Play", False)
            self._at_stated = gui.add_checkbox(
                "Project at the stated pose",
                False,
                hint="Residuals at the pose of the recording instead of the estimate",
            )
            self.panel = AnswerPanel(stage, "/frame", localizer, False, follow)
        for handle in (self._slider, self._play, self._at_stated):
            handle.on_update(lambda _: self._wake.set())
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        """Begin with the first frame."""
        self._thread.start()

    def close(self) -> None:
        """Stop after the frame under way."""
        self._closed.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(5)

    def _run(self) -> None:
        """Show the frame of the slider; what it passed meanwhile is left out."""
        shown: tuple[int, bool] | None = None
        while not self._closed.is_set():
            wanted = min(self._slider.value, len(self.frames) - 1), self._at_stated.value
            if wanted != shown:
                self._show(*wanted)
                shown = wanted
            if not self._play.value:
                self._wake.wait()
            elif not self._wake.wait(_PLAY_S) and self._server.get_clients():
                self._slider.value = (wanted[0] + 1) % len(self.frames)
            self._wake.clear()

    def _show(self, number: int, at_stated: bool) -> None:
        frame = self.frames[number]
        try:
            image = frame.read_image()
            estimate = self._localizer.localize(image, frame.camera)
            self._on_frame(frame)
        except InputError as error:
            self.panel.say(f"{frame.name}: {error}")
            return
        stated, by = stated_pose(frame, self._gripper_from_camera)
        located = LocatedImage(frame.name, image, estimate, None, stated, by)
        self.panel.show(located, (), at_stated)
