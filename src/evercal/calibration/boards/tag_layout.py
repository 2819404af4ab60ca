"""Where tags lie on a rigid thing: by a file that images confirm, or by bundle adjustment.

The thing need not be flat. Metres come from the side of one tag; the sides of the others are
estimated.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from evercal.calibration.boards.board import Board
from evercal.calibration.boards.corners import (
    BoardView,
    board_pose,
    board_pose_candidates,
)
from evercal.calibration.boards.intrinsics import rough_camera
from evercal.calibration.boards.layout_files import layout_readings, read_tags
from evercal.calibration.boards.marker_layout import Markers
from evercal.calibration.boards.tag_bundle import Bundle, adjusted
from evercal.calibration.boards.tags import Corners, square, view_of, with_corners
from evercal.classes import frozen
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, norms
from evercal.storage.text_files import named_errors
from evercal.typing import Array, ArrayPair, Size, Strings

_MAX_MISFIT = 0.1
"""Maximum residual of a layout in an image, sides of a tag."""
_FITS = 0.02
"""Residual below which no other reading of a file is tried."""
_TRIED_IMAGES = 4
"""Number of images that choose between readings of a file."""
_SAME_SIZE = 0.01
"""Maximum relative difference of a tag's side in a file from the stated one."""
_UNITS = (1.0, 0.01, 0.001)
"""Metres of a unit of files."""
_WORSE = 1.5
"""Factor by which a layout that images contradict enlarges the residuals."""
_SCALES = np.geomspace(0.2, 5, 41)
"""Sides of a tag that are tried first, sides of the kept one."""
_MOST_IMAGES = 60
"""Number of images that place a tag."""
_LEAST_IMAGES = 2
"""Least number of images that place a tag: in one, a large tag far away looks like a small one."""
_AT_ONCE = 0.7
"""Tags are placed together with the one of most images if they have this share of them."""


@frozen
class Arrangement:
    """Finds how the tags of a board lie."""

    board: Board
    """Side of its tags; if its tag is stated, of that one."""
    size: Size
    """Width and height of the images."""
    camera: Camera | None = None
    """Stated intrinsics."""
    file: Path | None = None
    """Where tags lie; if omitted, the images show it."""

    def __call__(self, found: Mapping[str, Markers]) -> tuple[Board, Strings]:
        """Return the board with a layout, and what is to be known about it."""
        twice = {number for own in found.values() for number in own.twice.tolist()}
        shown = [markers.without(twice) for markers in found.values()]
        counts = Counter(number for own in shown for number in own.ids.tolist())
        if not counts:
            return self.board, ()
        points = square(self.board.size_m)
        views = [BoardView(points, own) for markers in shown for own in markers.corners]
        camera = self.camera or rough_camera(views, *self.size, "pinhole")
        if self.file:
            corners, notes = self._read(self.file, shown, camera)
        else:
            corners, notes = self._estimated(
                shown,
                counts,
                camera,
            )
        return with_corners(self.board, corners), notes

    def _read(
        self, path: Path, found: Sequence[Markers], camera: Camera
    ) -> tuple[Corners, Strings]:
        tags = read_tags(path)
        shown = [own for own in found if len({*tags}.intersection(own.ids)) > 1]
        if not shown:
            raise InputError(
                f"{path}: no image shows two of its tags, which confirm their axes; show two at"
                " once, or give `tag` N without `layout`"
            )
        images = shown[:: -(-len(shown) // _TRIED_IMAGES)]
        misfit = np.inf
        corners: Corners = {}
        with named_errors(path, "layout of tags"):
            for reading in layout_readings(tags, self.board.size_m):
                # Images of tags in one plane fit several readings.
                own = np.mean([_misfit(image, reading, camera) for image in images])
                if own < misfit - 1e-6:
                    misfit = float(own)
                    corners = reading
                if misfit < _FITS:
                    break
        if misfit > _MAX_MISFIT:
            raise InputError(
                f"{path}: its tags lie elsewhere in the images, by {100 * misfit:.0f} % of a side;"
                " correct it, or give `layout` estimate"
            )
        first = self.board.tag if self.board.tag in corners else min(corners)
        scale = self.board.size_m / _side(corners[first])
        corners = {number: scale * own for number, own in corners.items()}
        notes = []
        if min(abs(np.log(scale / unit)) for unit in _UNITS) > _SAME_SIZE:
            notes.append(
                f"warning: {path.name} was scaled by {scale:.5g}, so that tag {first} measures"
                f" {1000 * self.board.size_m:g} mm"
            )
        stated = bool(self.camera)
        rigid = adjusted(shown, Bundle(corners, camera), {*corners}, stated)
        loose = adjusted(shown, rigid, {first}, stated)
        if rigid.sigma_px > _WORSE * loose.sigma_px:
            apart = [
                norms(loose.corners[number] - corners[number]) for number in corners
            ]
            notes.append(
                f"warning: in the images, tags lie up to {1000 * np.max(apart):.1f} mm elsewhere"
                f" than in {path.name}; measure again, or give `layout` estimate"
            )
        return corners, tuple(notes)

    def _estimated(
        self, found: Sequence[Markers], counts: Counter[int], camera: Camera
    ) -> tuple[Corners, Strings]:
        kept = self.board.tag
        if kept is None:
            kept = min(counts, key=lambda number: (-counts[number], number))
        corners = _placed(found, kept, self.board.size_m, camera)
        if len(corners) < 2:
            raise InputError(
                f"no two images show tag {kept} beside the same other one; `layout` estimate takes"
                " images that show two tags or more"
            )
        alone = sorted({*counts} - {*corners})
        start = Bundle(corners, camera)
        corners = adjusted(found, start, {kept}, bool(self.camera)).corners
        sides = [f"{number} {1000 * _side(own):.2f}" for number, own in corners.items()]
        notes = [f"sides by the images, mm: {', '.join(sides)}"]
        if alone:
            names = ", ".join(map(str, alone))
            notes.append(
                "tags visible beside the others in fewer than two images, not used:"
                f" {names}"
            )
        return corners, tuple(notes)


def _side(corners: Array) -> float:
    return float(norms(np.diff(corners, axis=0)).mean())


def _misfit(markers: Markers, corners: Corners, camera: Camera) -> float:
    """Residual of tags in an image, parts of a side."""
    view = view_of(markers, corners)
    if not view:
        return np.inf
    misfits = [np.inf]
    with suppress(ValueError):
        for pose in board_pose_candidates(view, camera):
            errors = camera.project(pose.apply(view.points_m)) - view.pixels
            misfits.append(float(np.nan_to_num(norms(errors), nan=np.inf).mean()))
    return min(misfits) / _side(view.pixels[:4])


def _placed(
    found: Sequence[Markers], kept: int, size_m: float, camera: Camera
) -> Corners:
    """Place tags beside the kept one, each by the images that show it with placed ones.

    A tag has two similar poses in an image. That of the layout recurs in the images.
    """
    points = square(size_m)
    placed = {kept: points}
    while True:
        beside: dict[int, list[ArrayPair]] = {}
        for markers in found:
            view = view_of(markers, placed)
            if not view:
                continue
            base = board_pose(view, camera).camera_from_board.inverse()
            eye = base.translation_m
            others = markers.without(placed)
            for number, pixels in zip(others.ids.tolist(), others.corners, strict=True):
                poses = board_pose_candidates(BoardView(points, pixels), camera)
                if poses:
                    corners = (base @ SE3.stack(poses))[:, None].apply(points)
                    beside.setdefault(number, []).append((eye, corners - eye))
        most = max(map(len, beside.values()), default=0)
        if most < _LEAST_IMAGES:
            return placed
        for number, images in beside.items():
            if len(images) >= max(_LEAST_IMAGES, _AT_ONCE * most):
                few = images[:_MOST_IMAGES]
                sizes = [_recurring(few, scale) for scale in _SCALES]
                placed[number] = min(sizes, key=lambda pair: pair[0])[1]


def _recurring(images: Sequence[ArrayPair], scale: float) -> tuple[float, Array]:
    """The corners (4, 3) of a tag that are nearest to those in each image, and how near."""
    corners = [eye + scale * arms for eye, arms in images]
    candidates = np.concatenate(corners)
    costs = [norms(candidates[:, None] - own).mean(-1).min(1) for own in corners]
    cost = np.median(costs, 0)
    return float(cost.min()), candidates[cost.argmin()]
