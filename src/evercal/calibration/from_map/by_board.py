"""Base frame and metres of a map by a board that stands still in its images; no robot."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from evercal.calibration.boards.board_poses import read_board_poses
from evercal.calibration.from_map.align import MapAlignment, about
from evercal.calibration.from_map.by_points import align_by_points
from evercal.calibration.pose_pairs.checks import SIZE_SIGMA
from evercal.geometry import SE3, UncertainPose, axis_deviation
from evercal.recordings import read_image
from evercal.typing import Array, PathLike

if TYPE_CHECKING:
    from evercal.localization.localizer import Localizer


def align_by_board(
    localizer: "Localizer",
    scene: str,
    board_poses: PathLike,
    base_from_board: UncertainPose | None = None,
    scale_known: bool = True,
) -> MapAlignment:
    """Estimate the base frame from the corners of a board at a known place.

    Args:
        localizer: Localizer of the store.
        scene: Name of the scene.
        board_poses: File of `evercal detect`: two images or more, from different places.
        base_from_board: Place of the board. By default the board frame is the base frame.
        scale_known: Whether the scene was learned in metres.
    """
    place = base_from_board or UncertainPose.exact(SE3.identity())
    corners: dict[str, Array] = {}
    picks = []
    for detected in read_board_poses(board_poses).detected:
        image = read_image(Path(board_poses).parent / detected.name)
        view = detected.view
        assert view
        names = [f"corner {point.round(6).tolist()}" for point in view.points_m]
        in_base = place.pose.apply(view.points_m)
        corners.update(zip(names, in_base, strict=True))
        picks.append((detected.name, image, dict(zip(names, view.pixels, strict=True))))
    by_corners = align_by_points(
        localizer, scene, corners, picks, scale_known, SIZE_SIGMA
    )
    by_place = place @ place.pose.inverse()
    covariance = by_corners.base_covariance + by_place.covariance
    middle = np.mean([*corners.values()], axis=0)
    return replace(
        by_corners,
        base_covariance=covariance,
        sigma=axis_deviation(about(-middle, covariance)),
    )
