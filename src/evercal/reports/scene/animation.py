"""Located images as frames of a video: each with its landmarks, and the map seen from above."""

import itertools
import textwrap
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError
from evercal.geometry import UncertainPose
from evercal.reports.answers import Answer
from evercal.reports.charts import COLOURS, plain
from evercal.reports.pictures import draw_residuals, landmark_errors, scene_camera
from evercal.reports.scene.frusta import Ellipsoid, Frustum, readable_scale
from evercal.reports.scene.map_parts import resized
from evercal.reports.scene.side_views import (
    ABOVE,
    Surroundings,
    draw_ellipse,
    draw_frame,
    draw_frustum,
    draw_surroundings,
    set_plane,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from evercal.localization.learned import LearnedLocalizer

Image = NDArray[np.uint8]

ENDING = ".mp4"
FRAMES_A_SECOND = 10
_SIZE_IN, _DPI = (12.8, 5.6), 100  # even numbers of pixels, as H.264 asks
_MAP_PANEL = (0.56, 0.245, 0.43, 0.685)
_MAP_ASPECT = (_MAP_PANEL[2] * _SIZE_IN[0]) / (_MAP_PANEL[3] * _SIZE_IN[1])
_WIDTH_PX = 640
"""Width of the image in a frame."""
_TRAIL = 25
"""Past positions whose ellipsoids are drawn."""
_STATUS = {"ok": "#1a7f37", "ambiguous": "#9a6700"}
_REFUSED = "#cf222e"
_QUIET = "#59636e"


def require_video(path: Path) -> None:
    """Check that a video can be written, before the images are located.

    Raises:
        InputError: Another ending, or the extra `video` is not installed.
    """
    if path.suffix.lower() != ENDING:
        raise InputError(
            f"--video {path}: not a video format of evercal; help: end it with {ENDING}"
        )
    try:
        import av  # noqa: F401  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputError("--video needs PyAV; help: pip install 'evercal[video]'") from None


def write_video(path: Path, frames: Iterator[Image]) -> None:
    """Write frames (H, W, 3) as H.264; the file appears when all of them were written.

    Raises:
        InputError: As `require_video`.
        OSError: As `evercal.storage.write_bytes`.
    """
    require_video(path)
    import av  # pyright: ignore[reportMissingImports]

    from evercal.storage.atomic import replacing

    first = next(frames)
    codec = "libx264" if "libx264" in av.codecs_available else "mpeg4"
    with replacing(path) as file, av.open(file, "w", format="mp4") as container:
        stream: Any = container.add_stream(codec, rate=FRAMES_A_SECOND)
        stream.height, stream.width = first.shape[:2]
        stream.pix_fmt = "yuv420p"  # the one that browsers and phones play
        for image in itertools.chain([first], frames):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))


@dataclass(frozen=True, eq=False)
class _Scene:
    """What the frames of one scene share."""

    surroundings: Surroundings
    bounds: NDArray[np.float64]
    times: int
    """Factor of the ellipsoids."""
    unit: str


class Animation:
    """The frames of a sequence of answers, in their order.

    Args:
        answers: One for each image.
        localizer: That located them.
        read: Reads an image file.
    """

    def __init__(
        self,
        answers: Sequence[Answer],
        localizer: "LearnedLocalizer",
        read: Callable[[Path], Image],
    ) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self._answers, self._localizer, self._read = answers, localizer, read
        self._figure = Figure(figsize=_SIZE_IN, dpi=_DPI, facecolor="white")
        self._canvas = FigureCanvasAgg(self._figure)
        names = {a.estimate.scene for a in answers if a.estimate.scene is not None}
        self._scenes = {name: self._scene(name) for name in names}

    def __len__(self) -> int:
        return len(self._answers)

    def __iter__(self) -> Iterator[Image]:
        shown: str | None = None
        paths: dict[str, list[UncertainPose]] = {name: [] for name in self._scenes}
        if paths:  # until the first answer, the scene of most images is shown
            shown = Counter(
                a.estimate.scene for a in self._answers if a.estimate.scene in paths
            ).most_common(1)[0][0]
        for answer in self._answers:
            estimate = answer.estimate
            pose = _accepted(answer)
            if pose is not None and estimate.scene is not None:
                shown = estimate.scene
                paths[shown].append(pose)
            self._figure.clear()
            self._draw_image(answer)
            if shown is not None:
                self._draw_map(shown, paths[shown], pose is not None)
            _write_words(self._figure, answer)
            self._canvas.draw()
            yield np.ascontiguousarray(np.asarray(self._canvas.buffer_rgba())[..., :3])

    def _scene(self, name: str) -> _Scene:
        from evercal.mapping.scene_map import SceneMap

        scene = next(s for s in self._localizer.contents.scenes if s.name == name)
        around = Surroundings.of(scene) if isinstance(scene, SceneMap) else Surroundings()
        here = [a for a in self._answers if a.estimate.scene == name]
        poses = [pose for answer in here if (pose := _accepted(answer)) is not None]
        eyes = np.reshape([pose.pose.translation_m for pose in poses], (-1, 3))
        sizes = sorted((Ellipsoid.of(pose) for pose in poses), key=lambda e: e.axes_m[-1])
        known = all(answer.unit_known for answer in here)
        return _Scene(
            around,
            _filling(around.bounds(eyes if len(eyes) or around.keyframes else np.zeros((1, 3)))),
            readable_scale(sizes[len(sizes) // 2 :][:1]),
            "m" if known else "unit unknown",
        )

    def _draw_image(self, answer: Answer) -> None:
        image, estimate = self._read(answer.path), answer.estimate
        large = resized(image, _WIDTH_PX)
        words = "no pose"
        errors = None
        if _accepted(answer) is not None:
            errors = landmark_errors(estimate, self._localizer, estimate.camera)
        if errors is not None:
            own = image.shape[0] / errors.height
            large, times = draw_residuals(large, errors, own)
            median = own * float(np.median(errors.errors_px))
            words = f"{len(errors.pixels)} landmarks, median residual {median:.2f} px,"
            words += f" lines {times} times as long"
        panel = self._figure.add_axes((0.012, 0.18, 0.49, 0.75))
        panel.imshow(large)
        panel.axis("off")
        panel.set_title(words, fontsize=9, color=_QUIET, loc="left")

    def _draw_map(self, name: str, path: list[UncertainPose], located: bool) -> None:
        scene = self._scenes[name]
        panel = self._figure.add_axes(_MAP_PANEL)
        extent = float(np.ptp(scene.bounds, axis=0).max())
        draw_surroundings(panel, scene.surroundings, ABOVE, 0.03 * extent)
        draw_frame(panel, ABOVE, 0.07 * extent, "base")
        for pose in path[-_TRAIL:]:
            draw_ellipse(panel, pose, ABOVE, scene.times, COLOURS[1])
        if path:
            eyes = np.array([pose.pose.translation_m for pose in path])[:, ABOVE]
            panel.plot(*eyes.T, ".-", color=COLOURS[1], linewidth=1, markersize=3, zorder=4)
        if located:
            camera = scene_camera(self._localizer, name)
            view = Frustum.of(path[-1].pose, camera)
            draw_frustum(panel, view, ABOVE, 0.08 * extent, COLOURS[1], 1.8)
        set_plane(panel, scene.bounds, ABOVE, "base", scene.unit)
        words = f"{name[:24]} from above: keyframes blue, path orange, 95 % ellipsoids"
        words += f" {scene.times} times as large" if scene.times > 1 else ""
        self._figure.text(0.52, 0.946, plain(words), fontsize=9, color=_QUIET)


def _filling(bounds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Bounds (2, 3), wider along x or y so that the panel shows more map and nothing white."""
    middle, size = bounds.mean(0), np.ptp(bounds, axis=0)
    x, y = size[:2]
    size[:2] = max(x, y * _MAP_ASPECT), max(y, x / _MAP_ASPECT)
    return np.stack([middle - size / 2, middle + size / 2])


def _accepted(answer: Answer) -> UncertainPose | None:
    """The pose of an answer; None unless it is `ok` with a finite covariance."""
    pose = answer.estimate.uncertain_pose
    ok = answer.estimate.status == "ok" and pose is not None
    return pose if ok and pose is not None and np.isfinite(pose.covariance).all() else None


def _write_words(figure: "Figure", answer: Answer) -> None:
    """Status, support and uncertainty below the pictures."""
    estimate, pose = answer.estimate, _accepted(answer)
    status = estimate.status.replace("_", " ")
    colour = _STATUS.get(estimate.status, _REFUSED)
    box = {"facecolor": colour, "edgecolor": "none", "boxstyle": "round,pad=0.4"}
    figure.text(
        0.02, 0.11, status, color="white", fontsize=13, weight="bold", va="center", bbox=box
    )
    words = [f"{estimate.scene or 'no scene'}"]
    if estimate.support:
        words.append(f"support {estimate.support:.1f}")
    words.append(f"{estimate.inliers} inliers")
    if pose is not None and answer.unit_known:
        words.append(f"sigma {pose.sigma_mm:.2f} mm, {pose.sigma_deg:.3f} deg per axis")
    first = plain("     ".join(words))
    figure.text(0.16, 0.11, first, fontsize=13, va="center")
    second = answer.path.name + (f": {estimate.reason}" if estimate.reason else "")
    figure.text(
        0.02, 0.045, plain(textwrap.shorten(second, 150)), fontsize=10, color=_QUIET, va="center"
    )
