"""`reconstruct`: camera poses from a plain video or images, by structure from motion (pycolmap).

    OUT/images/         chosen frames
    OUT/mask.png        black where all of them show the same, such as text, if they do
    OUT/database.db     features and matches
    OUT/sparse/0/       the model, read as a COLMAP recording

The unit of length is arbitrary until the map is aligned.
"""

import itertools
import math
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from evercal.classes import frozen
from evercal.errors import InputError, optional_module
from evercal.geometry import norms, spread
from evercal.recordings.fixed_pixels import COMPARED, LONG_SIDE, fixed_pixels
from evercal.recordings.images import read_image, write_image
from evercal.recordings.pictures import is_blank
from evercal.recordings.repeated_patches import reduced_grey
from evercal.recordings.streams import StreamFrame, stream
from evercal.typing import Image, PathLike

OnStep = Callable[[str, int, int], object]
"""Called with the name of the step, how much of it is done, and its total."""

_SMALL_PX = 320
"""Width of the copy in which motion and sharpness are measured, pixels."""
_LEAST_FRAMES = 12
"""Minimum number of frames of a reconstruction."""
_EXHAUSTIVE = 60
"""Up to this many frames are matched exhaustively. Longer sequences are matched sequentially, plus
exhaustively on a subset of this size for loop closure."""
_CAMERA_MODEL = "OPENCV"
"""Model of the camera that all frames share."""


@frozen
class Reconstruction:
    """Outcome, as JSON values."""

    frames: int
    """Chosen frames."""
    posed: int
    """Frames with a pose in the largest part."""
    parts: tuple[int, ...]
    """Frames of each part that does not connect to the others, largest first."""
    points: int
    """Triangulated points of the largest part."""
    residual_px: float
    """Mean reprojection error."""


def reconstruct(
    source: PathLike,
    out: PathLike,
    motion: float = 0.04,
    most_frames: int = 300,
    on_step: OnStep = lambda *_: None,
) -> Reconstruction:
    """Reconstruct camera poses from a video or a folder of images of one camera.

    Args:
        source: Video file or folder.
        out: New or empty folder.
        motion: Median motion of corners from one chosen frame of a video to the next, parts of its
            width.
        most_frames: Maximum number of frames; of more, every n-th is used.
        on_step: Called with the current step.
    """
    pycolmap = optional_module("pycolmap", "reconstruction needs pycolmap", "colmap")
    root = Path(out)
    if root.exists() and any(root.iterdir()):
        raise InputError(f"{root}: is not empty; give a new folder")
    names = _chosen(str(source), root / "images", motion, most_frames)
    on_step("choosing frames", len(names), len(names))
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = _CAMERA_MODEL
    mask = _mask(root, names)
    if mask:
        reader.camera_mask_path = mask
    on_step("detecting features", 0, 1)
    pycolmap.extract_features(
        root / "database.db",
        root / "images",
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
    )
    on_step("matching", 0, 1)
    _match(pycolmap, root, names)
    models = _mapped(pycolmap, root, len(names), on_step)
    if not models:
        raise InputError(
            f"{source}: its frames do not connect to a model; record a textured scene slowly, with"
            " sideways motion and at least two thirds of overlap"
        )
    best = models[0]
    return Reconstruction(
        frames=len(names),
        posed=best.num_reg_images(),
        parts=tuple(model.num_reg_images() for model in models),
        points=best.num_points3D(),
        residual_px=float(best.compute_mean_reprojection_error()),
    )


def _chosen(source: str, images: Path, motion: float, most: int) -> list[str]:
    is_folder = Path(source).is_dir()
    frames = stream(source)
    if not is_folder:
        frames = _moving(frames, motion)
    names = []
    for frame in frames:
        if is_folder:
            name = f"{Path(frame.name).stem}.jpg"
        else:
            name = f"{int(frame.name):06d}.jpg"
        if (images / name).exists():  # where a.jpg and A.jpg are one file, too
            raise InputError(
                f"{source}: has two images called {Path(name).stem}; rename one"
            )
        images.mkdir(parents=True, exist_ok=True)
        write_image(images / name, frame.image)
        names.append(name)
    step = max(1, math.ceil(len(names) / most))
    keep = names[::step]
    for name in set(names) - set(keep):
        (images / name).unlink()
    if len(keep) < _LEAST_FRAMES:
        raise InputError(
            f"{source}: {len(keep)} frames to reconstruct, at least {_LEAST_FRAMES} are required;"
            " record longer, or move more"
        )
    return keep


def _mask(root: Path, names: list[str]) -> Path | None:
    """A mask of what all images show alike, if there is something: features are not of it."""
    greys = []
    sizes = set()
    for number in spread(len(names), COMPARED):
        image = read_image(root / "images" / names[number])
        greys.append(reduced_grey(image, LONG_SIDE))
        sizes.add(image.shape[:2])
    if len(sizes) > 1:
        return None
    fixed = fixed_pixels(greys)
    if not fixed.any():
        return None
    keep = np.where(fixed, 0, 255).astype(np.uint8)
    [(height, width)] = sizes
    keep = cv2.resize(keep, (width, height), interpolation=cv2.INTER_NEAREST)
    path = root / "mask.png"
    grey = np.repeat(keep[..., None], 3, 2)
    write_image(path, np.asarray(grey, np.uint8))
    return path


def _moving(frames: Iterator[StreamFrame], motion: float) -> Iterator[StreamFrame]:
    """Yield the sharpest frame of each step of a moving camera."""
    last: Image | None = None
    best: tuple[float, StreamFrame, Image] | None = None
    for frame in frames:
        if is_blank(frame.image):  # such as black ones before the picture comes
            continue
        grey = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
        scale = _SMALL_PX / grey.shape[1]
        resized = cv2.resize(
            grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA
        )
        small = np.asarray(resized, np.uint8)
        moved = _motion(last, small)
        if best and moved > 1.5 * motion:
            yield best[1]
            last = best[2]
            best = None
            moved = _motion(last, small)
        if moved > motion:
            sharp = float(cv2.Laplacian(small, cv2.CV_64F).var())
            if not best or sharp > best[0]:
                best = (sharp, frame, small)
    if best:
        yield best[1]


def _motion(before: Image | None, now: Image) -> float:
    """Median motion of corners, parts of the width; infinite if most are lost."""
    if before is None:
        return np.inf
    corners = cv2.goodFeaturesToTrack(before, 200, 0.01, 7)
    if corners is None:
        return np.inf
    moved, status, _ = cv2.calcOpticalFlowPyrLK(before, now, corners, None)  # pyright: ignore
    tracked = status.ravel() == 1
    if tracked.mean() < 0.3:
        return np.inf
    lengths = norms((moved - corners)[tracked])
    return float(np.median(lengths)) / _SMALL_PX


def _match(pycolmap: Any, root: Path, names: list[str]) -> None:
    database = root / "database.db"
    if len(names) <= _EXHAUSTIVE:
        pycolmap.match_exhaustive(database)
        return
    pycolmap.match_sequential(database)
    some = [names[i] for i in spread(len(names), _EXHAUSTIVE)]
    pairs = itertools.combinations(some, 2)
    file = root / "pairs.txt"
    lines = "".join(f"{first} {second}\n" for first, second in pairs)
    file.write_text(lines, encoding="utf-8")
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = file
    pycolmap.match_image_pairs(database, pairing_options=pairing)


def _mapped(pycolmap: Any, root: Path, count: int, on_step: OnStep) -> list[Any]:
    working = root / "mapping"
    done = itertools.count(1)
    working.mkdir()
    on_step("mapping", 0, count)
    parts = pycolmap.incremental_mapping(
        root / "database.db",
        root / "images",
        working,
        next_image_callback=lambda: on_step("mapping", min(next(done), count), count),
    )
    on_step("mapping", count, count)
    shutil.rmtree(working)
    models = sorted(parts.values(), key=lambda model: -model.num_reg_images())
    for number, model in enumerate(models):
        folder = root / "sparse" / str(number)
        folder.mkdir(parents=True)
        model.write(folder)
    return models
