"""Videos of located images: each with its landmarks, beside the map seen from above."""

import itertools
import textwrap
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.mapping.scene_map import SceneMap
from evercal.reports.answers import Answer, finite_pose
from evercal.reports.charts import COLOURS, plain
from evercal.reports.overlay import draw_landmarks
from evercal.reports.scene import (
    ABOVE,
    Frustum,
    Line,
    Surroundings,
    draw_view,
    frame_lines,
    frustum_line,
)

if TYPE_CHECKING:
    from evercal.localization.learned import LearnedLocalizer

Image = NDArray[np.uint8]

ENDING = ".mp4"
FRAMES_A_SECOND = 10
_CODEC = "vp09"
"""VP9: OpenCV's wheels write it, and browsers play it."""
_SIZE_IN, _DPI = (12.8, 5.6), 100
_GOOD, _BAD = "#1a7f37", "#cf222e"


def require_ending(path: Path) -> None:
    """Check the name of a video before the images are located."""
    if path.suffix.lower() != ENDING:
        raise InputError(
            f"--video {path}: not a video format of evercal; help: end it with {ENDING}"
        )


def write_video(path: Path, frames: Iterator[Image]) -> None:
    """Write frames (h, w, 3) as MP4; the file appears when all of them were written."""
    import cv2

    first = next(frames)
    with TemporaryDirectory(prefix=".video-", dir=path.parent) as folder:
        whole = Path(folder) / f"video{ENDING}"
        code, size = cv2.VideoWriter.fourcc(*_CODEC), (first.shape[1], first.shape[0])
        writer = cv2.VideoWriter(str(whole), cv2.CAP_FFMPEG, code, FRAMES_A_SECOND, size)
        if not writer.isOpened():
            raise InputError(
                "--video: this OpenCV cannot write videos; help: install opencv-python-headless,"
                " or pass --overlay DIR for pictures"
            )
        for image in itertools.chain([first], frames):
            writer.write(image[..., ::-1])
        writer.release()
        whole.replace(path)


def animate(
    answers: Sequence[Answer], localizer: "LearnedLocalizer", read: Callable[[Path], Image]
) -> Iterator[Image]:
    """Draw one frame for each answer; `read` reads an image file."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=_SIZE_IN, dpi=_DPI, facecolor="white")
    canvas = FigureCanvasAgg(figure)
    scenes = {scene.name: scene for scene in localizer.contents.scenes}
    found = [a.estimate.scene for a in answers if a.estimate.scene is not None]
    maps = {name: _MapView(scenes[name], answers) for name in set(found)}
    shown = found[0] if found else None
    for i, answer in enumerate(answers):
        good = answer.estimate.status == "ok"
        shown = answer.estimate.scene if good else shown
        drawn = draw_landmarks(read(answer.path), answer.estimate, localizer)
        figure.clear()
        panel: Any = figure.add_axes((0.012, 0.1, 0.49, 0.75))
        panel.imshow(drawn.image)
        panel.axis("off")
        panel.set_title(plain(textwrap.shorten(drawn.summary, 90)), fontsize=9, loc="left")
        if shown is not None:
            maps[shown].draw(figure.add_axes((0.57, 0.13, 0.42, 0.72)), i)
        words, colour = plain(_words(answer)), _GOOD if good else _BAD
        figure.suptitle(words, color=colour, x=0.015, y=0.97, ha="left", fontsize=13)
        canvas.draw()
        yield np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])


class _MapView:
    """A map from above, with the path of the camera."""

    def __init__(self, scene: Any, answers: Sequence[Answer]) -> None:
        self._name, self._camera = scene.name, scene.adjusted_camera
        self._around = Surroundings.of(scene) if isinstance(scene, SceneMap) else Surroundings()
        here = [a.estimate.status == "ok" and a.estimate.scene == scene.name for a in answers]
        self._poses = [
            answer.estimate.base_from_camera if own else None
            for answer, own in zip(answers, here, strict=True)
        ]
        self._eyes = np.array(
            [np.full(3, np.nan) if pose is None else pose.translation_m for pose in self._poses]
        )
        known = all(a.unit_known for a, own in zip(answers, here, strict=True) if own)
        self._names = "base", "m" if known else "unit unknown"

    def draw(self, panel: Any, number: int) -> None:
        """Draw the camera of an image and the path up to it."""
        seen = self._eyes[np.isfinite(self._eyes[:, 0])]
        bounds = self._around.bounds(np.concatenate([np.zeros((1, 3)), seen]))
        extent, pose = float(np.ptp(bounds, axis=0).max()), self._poses[number]
        lines = [*frame_lines(0.07 * extent), Line(self._eyes[: number + 1], COLOURS[1])]
        if pose is not None:
            view = Frustum.of(pose, self._camera)
            lines.append(frustum_line(view, 0.08 * extent, COLOURS[1], 1.8))
        draw_view(panel, ABOVE, lines, self._around, bounds, self._names)
        words = f"{self._name[:24]} from above: keyframes blue, camera and path orange"
        panel.set_title(plain(words), fontsize=9, loc="left")


def _words(answer: Answer) -> str:
    estimate, pose = answer.estimate, finite_pose(answer.estimate)
    words = [answer.path.name, estimate.status.replace("_", " "), f"{estimate.inliers} inliers"]
    if estimate.status == "ok" and pose is not None and answer.unit_known:
        words.append(f"sigma {pose.sigma_mm:.2f} mm, {pose.sigma_deg:.3f} deg per axis")
    return "    ".join(words)
