"""`evercal localize`."""

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

from evercal.cli.arguments import (
    Point,
    camera_for,
    open_localizer,
    point_dict,
    point_of,
    point_text,
)
from evercal.cli.console import progress_bar, require_folder, require_writable
from evercal.cli.options import At, Device, Folder, Images, Intrinsics, Store, Verb
from evercal.reports.answers import Answer, answer_row, budget_of, finite_pose, unit_known

if TYPE_CHECKING:
    import numpy as np

    from evercal.geometry import Camera
    from evercal.localization.estimate import PoseEstimate
    from evercal.localization.learned import LearnedLocalizer


@dataclass(frozen=True)
class Localize(Verb):
    """Estimate the camera pose of images, in the base frame of the scene they show.

    Exit code 1 if no image was located.

    Example: evercal localize cell.evercal image.jpg --overlay overlays/
    """

    store: Store
    images: Images
    """Image files or folders of them."""
    camera: Intrinsics = None
    overlay: Folder = None
    """Output folder for copies of the images with their landmarks and residuals."""
    video: Annotated[Path | None, arg(metavar="FILE.mp4", help_behavior_hint="")] = None
    """A video of the sequence: each image with its landmarks and residuals, beside the map seen
    from above with the camera's path and its uncertainty."""
    at: At = None
    device: Device = "auto"

    def run(self) -> int:
        from evercal.recordings.image_files import image_files

        point = point_of(self.at)
        files = image_files(self.images)
        camera = camera_for(self.camera, files)
        require_folder(self.overlay, "--overlay")
        if self.video is not None:
            from evercal.reports.video import require_ending

            require_writable(self.video, "--video")
            require_ending(self.video)
        localizer = open_localizer(self.store, self.device)
        answers = self._answers(localizer, files, camera)
        if self.video is not None:
            self._animate(self.video, localizer, answers)
        located = sum(answer.estimate.status == "ok" for answer in answers)
        lines = [as_text(answer, point) for answer in answers]
        if self.video is not None:
            lines.append(f"wrote {self.video}")
        record = {"images": [as_dict(answer, point) for answer in answers]}
        self.answer(record, lines, self._next(files, located))
        return 0 if located else 1

    def _answers(
        self, localizer: "LearnedLocalizer", files: list[Path], camera: "Camera | None"
    ) -> "list[Answer]":
        """The answer for each image; times include decoding."""
        from evercal.localization.parallel import in_parallel
        from evercal.recordings import read_image, write_image
        from evercal.reports.overlay import draw_landmarks

        def answer(number: int) -> Answer:
            path, began = files[number], time.perf_counter()
            image = read_image(path)
            estimate = localizer.localize(image, camera)
            milliseconds = 1000 * (time.perf_counter() - began)
            known = unit_known(localizer, estimate.scene)
            if self.overlay is not None and estimate.scene is not None:
                drawn = draw_landmarks(image, estimate, localizer, camera, width=image.shape[1])
                write_image(self.overlay / _overlay_name(files, number), drawn.image)
            return Answer(path, estimate, milliseconds, known)

        answers = []
        with progress_bar("localizing", len(files), "image") as bar:
            for item in in_parallel(answer, range(len(files))):
                answers.append(item)
                bar.update()
        return answers

    def _animate(self, path: Path, localizer: "LearnedLocalizer", answers: list[Answer]) -> None:
        from evercal.recordings import read_image
        from evercal.reports.video import animate, write_video

        with progress_bar("drawing", len(answers), "image") as bar:

            def read(file: Path) -> "np.ndarray":
                bar.update()
                return read_image(file)

            write_video(path, animate(answers, localizer, read))

    def _next(self, files: list[Path], located: int) -> tuple[object, ...]:
        if not located:
            return "learn", self.store, "RECORDING"
        if self.overlay is None:
            return "localize", self.store, files[0], "--overlay", "DIR"
        return "evaluate", self.store, "RECORDING"


def _overlay_name(files: list[Path], number: int) -> str:
    stems = [path.stem for path in files]
    again = f"-{number + 1}" if stems.count(stems[number]) > 1 else ""
    return f"{stems[number]}{again}-overlay.png"


def as_dict(answer: Answer, point: Point | None = None) -> dict[str, object]:
    """One image's entry in the JSON output, see `answer_row`. `point` is that of --at."""
    entry, uncertain = answer_row(answer), finite_pose(answer.estimate)
    if point is not None:
        metric = uncertain if answer.unit_known else None
        entry["at"] = None if metric is None else point_dict(point, metric)
    return entry


def as_text(answer: Answer, point: Point | None = None) -> str:
    """One image's block of text. `point` is that of --at."""
    estimate = answer.estimate
    share = (
        f"{estimate.inliers} ({100 * estimate.inlier_ratio:.0f} %), {answer.milliseconds:.0f} ms"
    )
    if estimate.base_from_camera is None:
        no = estimate.status.replace("_", " ")
        return f"{answer.path}\n  {no}: {estimate.reason}\n  inliers      {share}"
    pose = estimate.base_from_camera
    spread = [""] * 2
    if estimate.covariance is not None:
        sd = estimate.covariance.diagonal().clip(0) ** 0.5
        spread = [_numbers(1000 * sd[:3], ".2f"), _numbers(sd[3:] * 180 / math.pi, ".3f")]
        spread = [f"  sd {spread[0]} mm", f"  sd {spread[1]} deg"]
    unit = f"m{spread[0]}" if answer.unit_known else "in an unknown unit: run 'evercal align' first"
    lines = [
        str(answer.path),
        f"  scene        {estimate.scene}",
        f"  translation  {_numbers(pose.translation_m, '+.4f')} {unit}",
        f"  quaternion   {_numbers(pose.rotation_wxyz, '+.4f')} wxyz{spread[1]}",
        f"  inliers      {share}",
    ]
    if budget := _budget_words(estimate):
        lines.insert(-1, f"  budget       {budget} of the position's variance")
    uncertain = finite_pose(estimate)
    if point is not None and uncertain is not None and answer.unit_known:
        lines.insert(-1, f"  point        sd {point_text(point, uncertain)}")
    return "\n".join(lines)


def _budget_words(estimate: "PoseEstimate") -> str:
    parts = sorted(budget_of(estimate), key=lambda part: -part[1])
    return ", ".join(f"{t.name} {100 * share:.0f} %" for t, share in parts if share >= 0.005)


def _numbers(values: "np.ndarray", form: str) -> str:
    return " ".join(format(float(value), form) for value in values)
