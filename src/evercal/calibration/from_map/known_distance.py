"""Metres of a map by distances between points that were picked in images; no robot."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from evercal.calibration.from_map.align import MapAlignment
from evercal.calibration.from_map.by_points import (
    PICK_SIGMA_PX,
    Picks,
    located_picks,
    triangulated,
)
from evercal.errors import InputError
from evercal.geometry import SE3, axis_deviation
from evercal.mapping.map_frame import Similarity
from evercal.typing import Array, Image

if TYPE_CHECKING:
    from evercal.localization.localizer import Localizer

Ends = tuple[str, str]
"""Names of two points."""
SIGNIFICANT = 4.0
"""Disagreement of two distances that is reported, standard deviations."""


def by_distances(
    localizer: "Localizer",
    scene: str,
    distances: Mapping[Ends, float],
    picks: Sequence[tuple[str, Image, Mapping[str, Array]]],
) -> MapAlignment:
    """Estimate the scale of a scene; its frame stays its own.

    `distances` are metres between two points. Each point is picked in two images or more, see
    `align_by_points`.
    """
    unknown = {name: np.zeros(3) for _, _, pixels in picks for name in pixels}
    images = located_picks(localizer, scene, unknown, picks)
    places = {name: point for name, (point, _) in triangulated(images).items()}
    logarithms = []
    variances = []
    # Errors of poses by the intrinsics are common to all images.
    by_poses = 2 * max(np.trace(image.covariance[:3, :3]) / 3 for image in images)
    for ends, metres in distances.items():
        first, second = ends
        for name in ends:
            if name not in places:
                raise InputError(
                    f"point {name} was not picked in two located images from different places;"
                    f" those are {', '.join(places) or 'none'}"
                )
        between = places[second] - places[first]
        length = float(np.linalg.norm(between))
        if not metres > 0 or not length > 0:
            raise InputError(
                f"the distance from {first} to {second} is {metres} m; give two points and metres"
                " above 0"
            )
        logarithms.append(np.log(metres / length))
        own = sum(_covariance(images, name, places[name]) for name in ends)
        along = between / length
        variances.append((along @ own @ along + by_poses) / length**2)
    weight = 1 / np.array(variances)
    mean = float(np.average(logarithms, weights=weight))
    off = np.abs(np.array(logarithms) - mean)
    warnings = ()
    if (off * np.sqrt(weight)).max() > SIGNIFICANT:
        warnings = (f"the distances disagree by {100 * off.max():.1f} %: check them",)
    variance = max(1 / weight.sum(), float((off**2).max()))
    scale = float(np.exp(mean))
    cameras = np.stack([image.map_from_camera.translation_m for image in images])
    radius2 = scale**2 * float((cameras**2).sum(1).mean()) / 3
    covariance = np.diag(np.repeat([variance * radius2, 0.0], 3))
    return MapAlignment(
        Similarity(SE3.identity(), scale),
        covariance,
        len(distances),
        len(distances),
        f"{100 * np.sqrt((off**2).mean()):.2f} % root mean square",
        sigma=axis_deviation(covariance),
        warnings=warnings,
    )


def _covariance(images: Sequence[Picks], name: str, point: Array) -> Array:
    """(3, 3) of a triangulated point, unit of the map."""
    information = np.zeros((3, 3))
    for image in images:
        if name in image.names:
            ray = point - image.map_from_camera.translation_m
            depth2 = ray @ ray
            across = np.eye(3) - np.outer(ray, ray) / depth2
            information += across * (image.camera.fx / PICK_SIGMA_PX) ** 2 / depth2
    return np.linalg.inv(information)
