"""Videos of located images: each with its landmarks, beside the map seen from above."""

import itertools
import textwrap
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from evercal.errors import InputError
from evercal.reports.answers import Answer, finite_pose
from evercal.reports.charts import Panel, Shape, paint, write
from evercal.reports.overlay import draw_landmarks
from evercal.reports.scene import ABOVE, Axes, Frustum, Surroundings, view_panel
from evercal.typing import Image

if TYPE_CHECKING:
    from evercal.reports.inspected import LearnedLocalizer


ENDING = ".mp4"
"""Ending of the names of videos."""
FRAMES_A_SECOND = 10
"""Located images in a second of a video."""
_CODEC = "vp09"
"""VP9: OpenCV's wheels write it, and browsers play it."""
_SIZE = (1280, 560)
"""Width and height of a frame, pixels."""
_PICTURE = (620, 440)
"""Width and height of its picture at most, pixels."""
_PANEL = (540, 404)
"""Width and height of its chart, pixels."""
_LEFT = 15
"""Left edge of the picture, pixels."""
_PANEL_LEFT = 726
"""Left edge of the chart, pixels."""
_TOP = 84
"""Upper edge of both, pixels."""


def require_ending(path: Path) -> None:
    """Check the name of a video before the images are located."""
    if path.suffix.lower() != ENDING:
        raise InputError(
            f"`video` {path}: not a video format of evercal; help: end it with {ENDING}"
        )


def write_video(path: Path, frames: Iterator[Image]) -> None:
    """Write frames (h, w, 3) as MP4; the file appears when all of them were written."""
    import cv2

    first = next(frames)
    with TemporaryDirectory(prefix=".video-", dir=path.parent) as folder:
        whole = Path(folder) / f"video{ENDING}"
        code = cv2.VideoWriter.fourcc(*_CODEC)
        size = (first.shape[1], first.shape[0])
        writer = cv2.VideoWriter(
            str(whole), cv2.CAP_FFMPEG, code, FRAMES_A_SECOND, size
        )
        if not writer.isOpened():
            raise InputError(
                "`video`: this OpenCV cannot write videos; help: install opencv-python-headless,"
                " or pass `overlay` DIR for pictures"
            )
        count = 0
        for image in itertools.chain([first], frames):
            writer.write(image[..., ::-1])
            count += 1
        writer.release()
        # The writer is silent about a full disk.
        written = cv2.VideoCapture(str(whole)).get(cv2.CAP_PROP_FRAME_COUNT)
        if written < count:
            raise InputError(f"`video` {path}: cannot be written; is the disk full?")
        whole.replace(path)


def animate(
    answers: Sequence[Answer],
    localizer: "LearnedLocalizer",
    read: Callable[[Path], Image],
) -> Iterator[Image]:
    """Draw one frame for each answer; `read` reads an image file."""
    scenes = {scene.name: scene for scene in localizer.contents.scenes}
    maps = dict[str, Surroundings]()
    for answer in answers:
        name = answer.estimate.scene
        if name is not None and name not in maps:
            maps[name] = Surroundings.of(scenes[name])
    shown = next(iter(maps), None)
    for i, answer in enumerate(answers):
        estimate = answer.estimate
        ink = "red"
        if estimate.status == "ok":
            ink = "green"
            shown = estimate.scene
        width, height = _SIZE
        frame = np.full((height, width, 3), 255, np.uint8)
        image = read(answer.path)
        rows, columns = image.shape[:2]
        most_width, most_height = _PICTURE
        width = min(most_width, most_height * columns // rows)
        drawn = draw_landmarks(image, estimate, localizer, width=width)
        bottom = _TOP + len(drawn.image)
        frame[_TOP:bottom, _LEFT : _LEFT + width] = drawn.image
        summary = textwrap.shorten(drawn.summary, 90)
        write(frame, (summary, _LEFT, _TOP - 12, 0))
        if shown is not None:
            panel = _from_above(scenes[shown], maps[shown], answers, i)
            paint(frame, panel, _PANEL_LEFT, _TOP)
            words = f"{shown[:24]} from above: keyframes blue, camera and path orange"
            write(frame, (words, _PANEL_LEFT - 52, 32, 0))
        write(frame, (_words(answer), _LEFT, 32, 0), 19, ink)
        yield frame


def _from_above(
    scene: Any, around: Surroundings, answers: Sequence[Answer], number: int
) -> Panel:
    """A map with the camera of an image and its path up to it."""
    eyes = np.full((len(answers), 3), np.nan)
    view = None
    unit = "m"
    for i, answer in enumerate(answers):
        estimate = answer.estimate
        pose = estimate.base_from_camera
        if estimate.status != "ok" or estimate.scene != scene.name:
            continue
        if not answer.unit_known:
            unit = "unit unknown"
        if pose:
            eyes[i] = pose.translation_m
        if pose and i == number:
            view = Frustum.of(pose, scene.adjusted_camera)
    located = np.isfinite(eyes[:, 0])
    points = np.concatenate([np.zeros((1, 3)), eyes[located]])
    path = Shape("line", eyes[: number + 1, ABOVE], "orange", 2)
    return view_panel(
        _PANEL,
        Axes(unit=unit),
        around,
        points,
        view,
        [path],
    )


def _words(answer: Answer) -> str:
    estimate = answer.estimate
    pose = finite_pose(answer.estimate)
    words = [
        answer.path.name,
        estimate.status.replace("_", " "),
        f"{estimate.inliers} inliers",
    ]
    if estimate.status == "ok" and pose and answer.unit_known:
        words.append(f"sigma {pose.sigma_mm:.2f} mm, {pose.sigma_deg:.3f} deg per axis")
    return "    ".join(words)
