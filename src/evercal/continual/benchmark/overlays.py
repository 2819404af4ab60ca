"""One test image of every scene, and its contours by the poses of all strategies.

    OUT/overlays/SCENE/STRATEGY.png    the middle test image, by the first run that is complete
    OUT/overlays.png                   all of them, as Figures 7 to 9 of the paper

Points on the contours of the image have depths from a plane sweep of neighbouring training images,
so no strategy made them. They cover the contours where a pose is right.
"""

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

from evercal.continual.benchmark.figures import new_figure
from evercal.continual.benchmark.results import frame_row
from evercal.continual.learning.surfaces import frame_depths
from evercal.evaluation.metrics import FrameResult
from evercal.features.encoder import load_encoder
from evercal.features.views import working_image
from evercal.geometry import Camera, pose_distance
from evercal.recordings import Recording, posed_frames, stated_poses
from evercal.recordings.images import pixels_of, write_image
from evercal.typing import Array, Image, Strings

OVERLAYS = "overlays.png"
"""File of all pictures."""
_FOLDER = "overlays"
"""Folder of the pictures."""
_SHORT_SIDE = 240
"""Shorter side of pictures, pixels."""
_NEAREST = slice(0, 48, 4)
"""Training images of the plane sweep, by their distance in metres and radians."""
_EDGES = (60, 140)
"""Thresholds of Canny's contours."""
_ORANGE = (255, 150, 0)
"""Colour of contours, RGB."""


def record_overlay(
    folder: Path, strategy: str, scene: Recording, results: Sequence[FrameResult]
) -> None:
    """Draw the picture of a scene by a complete run, unless the folder of results has it.

    `results` are those of the test frames of the scene.
    """
    path = folder / _FOLDER / scene.name / f"{strategy}.png"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_image(path, _picture(scene, results[len(results) // 2]))


def _picture(scene: Recording, result: FrameResult) -> Image:
    """The test image in grey, its contours by the estimated pose, and the errors below."""
    import cv2

    grey, camera, points = _contours(scene)
    drawn = cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB)
    row = frame_row(result)
    text = row["outcome"]
    if result.estimated and np.isfinite(row["error_mm"]):
        text = f"{row['error_mm']:.0f} mm, {row['error_deg']:.1f} deg"
        pixels = camera.project(result.estimated.inverse().apply(points))
        for pixel in np.nan_to_num(pixels, nan=-1).clip(-1, 9999).round().astype(int):
            cv2.circle(drawn, pixel.tolist(), 0, _ORANGE)
    drawn[-20:] = 255
    place = (4, len(drawn) - 5)
    cv2.putText(drawn, text, place, 0, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
    return np.asarray(drawn, np.uint8)


@cache
def _contours(scene: Recording) -> tuple[Image, Camera, Array]:
    """The image in grey, its camera, and points (n, 3) of its contours in the base frame."""
    import cv2

    tests = posed_frames(scene.test)
    frame = tests[len(tests) // 2]
    train = posed_frames(scene.train)
    pose = frame.base_from_camera
    assert pose, "posed frames only"
    metres, radians = pose_distance(stated_poses(train), pose)
    nearest = np.argsort(metres + radians)[_NEAREST]
    frames = [frame, *(train[i] for i in nearest)]
    depths = frame_depths(frames, load_encoder(), _SHORT_SIDE)[0]
    short_side = min(_SHORT_SIDE, *frame.camera.size)
    grey, camera = working_image(frame.read_image(), frame.camera, short_side)
    rows, columns = np.nonzero(cv2.Canny(grey, *_EDGES))
    height, width = depths.shape
    known = depths[rows * height // camera.height, columns * width // camera.width]
    points = camera.unproject(np.column_stack([columns, rows])) * known[:, None]
    return grey, camera, pose.apply(points[np.isfinite(points).all(1)])


def draw_overlays(folder: Path, strategies: Strings) -> bool:
    """Put the pictures side by side: scenes down, strategies across. False without any."""
    scenes = sorted((folder / _FOLDER).glob("*"))
    if not scenes:
        return False
    figure = new_figure(1.9 * len(strategies), 1.7 * len(scenes))
    panels = figure.subplots(len(scenes), len(strategies), squeeze=False)
    for scene, row in zip(scenes, panels, strict=True):
        for strategy, panel in zip(strategies, row, strict=True):
            panel.axis("off")
            path = scene / f"{strategy}.png"
            if path.exists():
                panel.imshow(pixels_of(path))
                panel.set_title(f"{scene.name}, {strategy}", fontsize=7)
    figure.savefig(folder / OVERLAYS)
    return True
