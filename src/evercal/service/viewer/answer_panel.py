"""An answer in the page: the picture and numbers beside the scene, the camera in it."""

import threading
from collections.abc import Callable
from typing import Any

from evercal.localization.localizer import Localizer
from evercal.service.viewer.answers import AnswerView, LocatedImage, answer_view
from evercal.service.viewer.drawn import DrawnAnswer
from evercal.service.viewer.stage import Stage
from evercal.service.viewer.text import Rows, answer_html, note_html, picture_html


class AnswerPanel:
    """Picture and numbers; made inside the folder that it belongs to.

    Args:
        stage: The scene.
        name: Name of the nodes in the scene.
        localizer: The map.
        trail: Draw the way of the camera.
        follow: Called with the scene of an answer.
    """

    def __init__(
        self,
        stage: Stage,
        name: str,
        localizer: Localizer,
        trail: bool,
        follow: Callable[[str | None], Any],
    ):
        self._localizer, self._follow, gui = localizer, follow, stage.server.gui
        self._drawn, self._trail = DrawnAnswer(stage, name), trail
        self._lock = threading.Lock()  # the scene is chosen in another thread than answers come
        self._last: AnswerView | None = None
        self._scale = 1.0
        self._image = gui.add_html("")
        self._text = gui.add_html(note_html("No image yet."))

    def show(self, located: LocatedImage, more: Rows = (), at_stated: bool = False) -> None:
        """Show an answer; `more` are further rows."""
        view = answer_view(located, self._localizer, at_stated)
        self._follow(view.scene)
        with self._lock:
            self._last = view
            words = f"{located.name}, {view.state}, with landmarks and residuals"
            self._image.content = picture_html(view.picture, words)
            self._text.content = answer_html(view, more)
            self._drawn.show(view, self._scale)
            if self._trail:
                self._drawn.extend(view)

    def say(self, text: str) -> None:
        """Show a sentence above the last answer."""
        last = "" if self._last is None else answer_html(self._last)
        self._text.content = note_html(text) + last

    def resize(self, scale: float) -> None:
        """Draw the ellipsoid with another factor."""
        self._scale = scale
        self.redraw()

    def redraw(self) -> None:
        """Draw the last answer again, when other scenes are shown."""
        with self._lock:
            if self._last is not None:
                self._drawn.show(self._last, self._scale)
