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
from evercal.reports.scene import ABOVE, Frustum, Surroundings, view_panel
from evercal.typing import Image

if TYPE_CHECKING:
    from evercal.localization.learned import LearnedLocalizer


ENDING = ".mp4"
FRAMES_A_SECOND = 10
_CODEC = "vp09"
"""VP9: OpenCV's wheels write it, and browsers play it."""
_SIZE, _PICTURE, _PANEL = (1280, 560), (620, 440), (540, 404)
"""Width and height of a frame, of its picture at most, and of its chart, pixels."""
_LEFT = 15
_PANEL_LEFT = 726
_TOP = 84


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
        code = cv2.VideoWriter.fourcc(*_CODEC)
        size = (first.shape[1], first.shape[0])
        writer = cv2.VideoWriter(
            str(whole), cv2.CAP_FFMPEG, code, FRAMES_A_SECOND, size
        )
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
    answers: Sequence[Answer],
    localizer: "LearnedLocalizer",
    read: Callable[[Path], Image],
) -> Iterator[Image]:
    """Draw one frame for each answer; `read` reads an image file."""
    scenes = {scene.name: scene for scene in localizer.contents.scenes}
    found = [a.estimate.scene for a in answers if a.estimate.scene is not None]
    maps = {name: Surroundings.of(scenes[name]) for name in set(found)}
    shown = found[0] if found else None
    for i, answer in enumerate(answers):
        good = answer.estimate.status == "ok"
        shown = answer.estimate.scene if good else shown
        frame = np.full((*_SIZE[::-1], 3), 255, np.uint8)
        image = read(answer.path)
        width = min(_PICTURE[0], _PICTURE[1] * image.shape[1] // image.shape[0])
        drawn = draw_landmarks(image, answer.estimate, localizer, width=width)
        frame[_TOP:, _LEFT:][: len(drawn.image), :width] = drawn.image
        write(frame, (textwrap.shorten(drawn.summary, 90), _LEFT, _TOP - 12, 0))
        if shown is not None:
            paint(
                frame,
                _from_above(scenes[shown], maps[shown], answers, i),
                _PANEL_LEFT,
                _TOP,
            )
            words = f"{shown[:24]} from above: keyframes blue, camera and path orange"
            write(frame, (words, _PANEL_LEFT - 52, 32, 0))
        write(frame, (_words(answer), _LEFT, 32, 0), 19, "green" if good else "red")
        yield frame


def _from_above(
    scene: Any, around: Surroundings, answers: Sequence[Answer], number: int
) -> Panel:
    """A map with the camera of an image and its path up to it."""
    own = [
        (a, a.estimate.status == "ok" and a.estimate.scene == scene.name)
        for a in answers
    ]
    poses = [a.estimate.base_from_camera if shown else None for a, shown in own]
    eyes = np.array(
        [np.full(3, np.nan) if p is None else p.translation_m for p in poses]
    )
    seen = np.concatenate([np.zeros((1, 3)), eyes[np.isfinite(eyes[:, 0])]])
    view = (
        None
        if (pose := poses[number]) is None
        else Frustum.of(pose, scene.adjusted_camera)
    )
    path = Shape("line", eyes[: number + 1, ABOVE], "orange", 2)
    unit = "m" if all(a.unit_known for a, shown in own if shown) else "unit unknown"
    return view_panel(_PANEL, ABOVE, around, seen, view, [path], ("base", unit))


def _words(answer: Answer) -> str:
    estimate = answer.estimate
    pose = finite_pose(answer.estimate)
    words = [
        answer.path.name,
        estimate.status.replace("_", " "),
        f"{estimate.inliers} inliers",
    ]
    if estimate.status == "ok" and pose is not None and answer.unit_known:
        words.append(f"sigma {pose.sigma_mm:.2f} mm, {pose.sigma_deg:.3f} deg per axis")
    return "    ".join(words)
