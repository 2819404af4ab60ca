"""`evercal localize`."""

import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import TYPE_CHECKING, Annotated

from evercal.classes import frozen
from evercal.cli import args
from evercal.cli.console import numbers, require_folder, require_writable
from evercal.progress import progress_bar
from evercal.reports.answers import (
    Answer,
    answer_row,
    budget_of,
    finite_pose,
    unit_known,
)

if TYPE_CHECKING:
    import numpy as np

    from evercal.geometry import Camera
    from evercal.reports.inspected import LearnedLocalizer


@frozen
class Localize(args.Verb):
    """Estimate the camera pose of images in the base frame.

    Exit code 1 if no image was located.

    Example: evercal localize cell.evercal image.jpg --overlay overlays/
    """

    store: args.Store
    images: args.ImageFiles
    """Image files or folders of them."""
    scene: args.Scenes = ()
    camera: args.File = None
    """Intrinsics: 3x3 matrix as text, JSON, YAML, NPZ, ROS camera_info or OpenCV's storage.
    Default: those of the camera that recorded the scene."""
    overlay: args.Folder = None
    """Output folder for copies of the images with their landmarks and residuals."""
    video: Annotated[Path | None, args.shown("FILE.mp4")] = None
    """A video of the sequence: each image with its landmarks and residuals, beside the map seen
    from above with the camera's path and its uncertainty."""
    at: args.At = None
    device: args.Device = "auto"

    def run(self) -> int:
        from evercal.recordings.image_files import image_files

        point = args.Point.parse(self.at)
        files = image_files(self.images)
        camera = args.camera_for(self.camera, files)
        require_folder(self.overlay, "--overlay")
        if self.video:
            from evercal.reports.video import require_ending

            require_writable(self.video, "--video")
            require_ending(self.video)
        localizer = args.open_localizer(self.store, self.device, self.scene)
        # All of them before the first is printed.
        answers = self._answers(localizer, files, camera)
        records = []
        lines = []
        for answer in answers:
            records.append(_record(answer, point))
            lines += _lines(answer, point)
        lines += _summary(answers)
        if self.video:
            self._animate(self.video, localizer, answers)
            lines.append(f"wrote {self.video}")
        located = any(answer.estimate.status == "ok" for answer in answers)
        two_bases = [a.estimate for a in answers if a.estimate.alternatives_in]
        if two_bases:
            scene = two_bases[0].alternatives_in[0]
            then = ("localize", self.store, files[0], "--scene", scene)
        elif not located:
            then = ("learn", self.store, "RECORDING")
        elif not self.overlay:
            then = ("localize", self.store, files[0], "--overlay", "DIR")
        else:
            then = ("evaluate", self.store, "RECORDING")
        self.answer({"images": records}, *lines, then=then)
        return 0 if located else 1

    def _answers(
        self, localizer: "LearnedLocalizer", files: list[Path], camera: "Camera | None"
    ) -> "list[Answer]":
        """The answer for each image; times include decoding."""
        from evercal.localization.parallel import in_parallel
        from evercal.localization.pictures import localize_picture
        from evercal.recordings import read_image, write_image
        from evercal.reports.overlay import draw_landmarks

        def answer(number: int) -> Answer:
            path = files[number]
            began = perf_counter()
            estimate = localize_picture(localizer, path, camera)
            milliseconds = 1000 * (perf_counter() - began)
            known = unit_known(localizer, estimate.scene)
            if self.overlay and estimate.scene is not None:
                image = read_image(path)
                drawn = draw_landmarks(
                    image, estimate, localizer, camera, width=image.shape[1]
                )
                write_image(self.overlay / _overlay_name(files, number), drawn.image)
            return Answer(path, estimate, milliseconds, known)

        answers = []
        with progress_bar("localizing", len(files), "image") as bar:
            for item in in_parallel(answer, range(len(files))):
                answers.append(item)
                bar.update()
        return answers

    def _animate(
        self, path: Path, localizer: "LearnedLocalizer", answers: list[Answer]
    ) -> None:
        from evercal.recordings import read_image
        from evercal.recordings.images import is_readable
        from evercal.reports.video import animate, write_video

        answers = [answer for answer in answers if is_readable(answer.path)]
        with progress_bar("drawing", len(answers), "image") as bar:

            def read(file: Path) -> "np.ndarray":
                bar.update()
                return read_image(file)

            write_video(path, animate(answers, localizer, read))


def _overlay_name(files: list[Path], number: int) -> str:
    """A file name; all are numbered if images from two folders have one name.

    Capital letters do not make another name on Windows and macOS.
    """
    stem = files[number].stem
    if len({path.stem.lower() for path in files}) < len(files):
        stem = f"{number + 1}-{stem}"
    return f"{stem}-overlay.png"


def _record(answer: Answer, point: args.Point | None) -> dict[str, object]:
    record = answer_row(answer)
    if point:
        pose = finite_pose(answer.estimate)
        record["at"] = None
        if pose and answer.unit_known:
            record["at"] = point.record(pose)
    return record


def _lines(answer: Answer, point: args.Point | None) -> Iterator[str]:
    estimate = answer.estimate
    pose = estimate.base_from_camera
    share = f"({100 * estimate.inlier_ratio:.0f} %)"
    time_ms = f"{answer.milliseconds:.0f} ms"
    inliers = f"  inliers      {estimate.inliers} {share}, {time_ms}"
    yield str(answer.path)
    note = ""
    if estimate.parent_frame == "gripper":
        note = " (a thing in the gripper: the pose is gripper_from_camera)"
    if estimate.scene is not None:
        yield f"  scene        {estimate.scene_in_words}{note}"
    if not pose:
        yield f"  {estimate.status.replace('_', ' ')}: {estimate.reason}"
        yield inliers
        return
    sd_mm = ""
    sd_deg = ""
    if estimate.covariance is not None:
        spread = estimate.covariance.diagonal().clip(0) ** 0.5
        sd_mm = f"  sd {numbers(1000 * spread[:3], '.2f')} mm"
        sd_deg = f"  sd {numbers(spread[3:] * 180 / math.pi, '.3f')} deg"
    unit = f"m{sd_mm}"
    if not answer.unit_known:
        unit = "in an unknown unit: run 'evercal align' first"
    yield f"  translation  {numbers(pose.translation_m, '+.4f')} {unit}"
    yield f"  quaternion   {numbers(pose.rotation_wxyz, '+.4f')} wxyz{sd_deg}"
    budget = sorted(budget_of(estimate), key=lambda row: -row[1])
    causes = [
        f"{term.name} {100 * part:.0f} %" for term, part in budget if part >= 0.005
    ]
    if causes:
        yield f"  budget       {', '.join(causes)} of the position's variance"
    uncertain = finite_pose(estimate)
    if point and uncertain and answer.unit_known:
        yield f"  point        sd {point.text(uncertain)}"
    yield inliers


def _summary(answers: list[Answer]) -> Iterator[str]:
    """One line about several images: located where and how exactly, refused why."""
    if len(answers) < 2:
        return
    scenes: Counter[str] = Counter()
    refused: Counter[str] = Counter()
    sigmas: list[float] = []
    for answer in answers:
        estimate = answer.estimate
        pose = estimate.uncertain_pose
        if estimate.status != "ok":
            refused[estimate.status.replace("_", " ")] += 1
        else:
            scenes[str(estimate.scene)] += 1
            if pose and answer.unit_known:
                sigmas.append(pose.sigma_mm)
    line = f"{scenes.total()} of {len(answers)} images located"
    for words, counter in ((", in", scenes), ("; refused:", refused)):
        if counter:
            counts = ", ".join(f"{word} {n}" for word, n in counter.most_common())
            line += f"{words} {counts}"
    if sigmas:
        line += f"; standard deviation {median(sigmas):.2f} mm per axis (median)"
    yield line
