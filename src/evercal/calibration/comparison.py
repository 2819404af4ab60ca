"""Two calibrations of one camera: how far they are apart, and whether they agree.

A pose belongs to its intrinsics, so both are compared by their rays. The second is turned for the
intrinsics of the first. What is left of it is a pose, whose covariance both state, and rays that no
pose explains.
"""

from collections.abc import Sequence
from dataclasses import asdict, replace

import numpy as np
from scipy import stats

from evercal.calibration.framed_pose import FramedPose
from evercal.classes import frozen_arrays
from evercal.errors import InputError
from evercal.geometry import axis_deviation, length_mm_deg, norms
from evercal.geometry.rays import angles, fit_rays
from evercal.robot.mount import mount_named
from evercal.typing import Array, JsonObject, Pair, Strings

USUAL_DISTANCE_M = 0.5
"""Working distance where none is stated: from a wrist camera to a table."""
LIMIT = float(stats.chi2.ppf(0.95, 6))
"""Largest squared Mahalanobis distance of two answers that agree."""
SAME_MAP = np.diag(np.repeat([0.2e-3, np.deg2rad(0.008)], 3) ** 2)
"""Covariance of a shift in one map by changes of light and objects, metres and radians."""
_USUAL_SCATTER = np.diag(np.repeat([0.4e-3, np.deg2rad(0.01)], 3) ** 2)
"""Prior covariance of a single image in a map."""
_USUAL_WEIGHT = 5.0
"""Weight of the prior scatter, in images."""
Scatter = Sequence[tuple[Array, int]]
"""Covariances (6, 6) of single images about their mean, each with the number of images."""
_PARAMETER = 4.0
"""A cause with one more parameter has to explain this much more of the squared distance."""
_CAUSES = (
    "a scale: the size of the board, the focal length, or lengths of the arm",
    "the zero of a joint: a turn about the axis of the {}",
    "the camera was turned in its mount, or the principal point differs",
    "the camera was displaced without a turn",
    "the camera, its mount or the board moved between both recordings, or the arm errs by more than"
    " its noise shows",
)


@frozen_arrays
class Comparison:
    """Distance of two calibrations."""

    distance_m: float
    """Working distance."""
    rays_deg: Pair
    """Angle between rays over the middle of the image: median, and 90 % are below. Without
    intrinsics, that of the optical axes."""
    rays_mm: Pair
    """Distance of points at the working distance: median, and 90 % are below."""
    pose_mm: float
    """Distance of the camera positions."""
    pose_deg: float
    """Rotation that explains the rays best."""
    left_deg: float
    """Median angle between rays that no pose takes away."""
    sigma_mm: float
    """Standard deviation of the difference per axis, as both state it."""
    sigma_deg: float
    """The same of the rotation."""
    d2: float
    """Squared Mahalanobis distance of the poses: 6 is expected, 95 % are below 12.6."""
    shared: Strings
    """What both have in common, so that its errors do not show in the difference."""
    cause: str
    """Likeliest cause of a disagreement; empty if both agree."""
    notes: Strings
    """How they were compared."""

    @property
    def agree(self) -> bool:
        """Whether the difference is within the 95 % ellipsoid of what both state."""
        return self.d2 <= LIMIT

    @property
    def verdict(self) -> str:
        """One or two sentences."""
        bound = f"(d2 {self.d2:.1f}, 95 % are below {LIMIT:.1f})."
        if self.agree:
            return f"These two agree {bound}"
        return f"These two disagree {bound} The likeliest cause: {self.cause}."

    def to_dict(self) -> JsonObject:
        """Return JSON values."""
        return {**asdict(self), "agree": self.agree, "verdict": self.verdict}


def compare(
    first: FramedPose,
    second: FramedPose,
    distance_m: float | None = None,
    measured: Scatter = (),
) -> Comparison:
    """Compare two calibrations of one camera, see `Calibration.distance`.

    `measured` is the scatter of the images of both, where they were located in one map.

    Raises:
        InputError: The mounts, the frames or the image sizes differ.
    """
    for name in ("mount", mount_named(first.mount).parent, "camera"):
        values = [getattr(one.frames, name, one.mount) for one in (first, second)]
        if values[0] != values[1] and all(values):
            raise InputError(
                f"{name} is {values[0]!r} in the first and {values[1]!r} in the second: compare"
                " calibrations of one camera in the same frames"
            )
    notes = []
    distance = distance_m
    if distance is None:
        distance = USUAL_DISTANCE_M
        notes.append("no working distance is stated: that of a wrist camera is taken")
    if not 0 < distance < np.inf:
        raise InputError(f"`distance` {distance}: give metres above 0")
    shared = _shared(first, second)
    covariance = first.covariance + second.covariance
    if len(measured) > 1:
        shared = ("map", *shared)
        covariance = same_map_covariance(measured)
    own, other, second = _rays(first, second, notes)
    a = first.parent_from_child
    b = second.parent_from_child
    shift = b.translation_m - a.translation_m
    error = np.concatenate([shift, (a.inverse() @ b).log()[3:]])
    behind = a.rotation.apply(own)
    ahead = b.rotation.apply(other)
    points = shift + distance * (ahead - behind)
    information = np.linalg.pinv(covariance)
    d2 = float(error @ information @ error)
    cause = ""
    if d2 > LIMIT:
        cause = _cause(first, error, information)
    return Comparison(
        distance,
        _spread(np.rad2deg(angles(behind, ahead))),
        _spread(1000 * norms(points)),
        *length_mm_deg(error),
        float(np.rad2deg(np.median(angles(own, other)))),
        *axis_deviation(covariance),
        d2,
        shared,
        cause,
        tuple(notes),
    )


def _rays(
    first: FramedPose, second: FramedPose, notes: list[str]
) -> tuple[Array, Array, FramedPose]:
    """Rays (m, 3) of both in camera frames, and the second one for the lens of the first."""
    lens = first.camera or second.camera
    if not lens:
        notes.append("neither states intrinsics: frames are compared, not rays")
        axis = np.array([[0.0, 0.0, 1.0]])
        return axis, axis, second
    if None in (first.camera, second.camera):
        notes.append("only one states intrinsics: they are taken for both")
    stated = second.camera or lens
    second = replace(second, camera=stated).for_lens(lens)
    _, own, other = fit_rays(lens, stated)
    return own, other, second


def same_map_covariance(measured: Scatter) -> Array:
    """Covariance (6, 6) of the difference of two poses in one map, whose errors cancel."""
    scatter = pooled_scatter(measured)
    return scatter * sum(1 / count for _, count in measured) + SAME_MAP


def pooled_scatter(measured: Scatter) -> Array:
    """Covariance (6, 6) of a single image by all of them and a prior."""
    total = _USUAL_WEIGHT * _USUAL_SCATTER
    weight = _USUAL_WEIGHT
    for scatter, count in measured:
        total = total + (count - 1) * scatter
        weight = weight + count - 1
    return total / weight


def _shared(first: FramedPose, second: FramedPose) -> Strings:
    shared = []
    if first.camera and first.camera == second.camera:
        shared.append("intrinsics")
    used = [{use.name for use in one.images if use.used} for one in (first, second)]
    if used[0] & used[1]:
        shared.append("images")
    return tuple(shared)


def _cause(first: FramedPose, error: Array, information: Array) -> str:
    """The cause whose directions explain the difference (6,) with the fewest parameters."""
    rotation = first.parent_from_child.rotation_matrix()
    axis = np.array([0.0, 0.0, 1.0])
    lever = np.cross(axis, first.parent_from_child.translation_m)
    along = np.concatenate([rotation[:, 2], np.zeros(3)])
    joint = np.concatenate([lever, rotation[2]])
    six = np.eye(6)
    directions = (along[:, None], joint[:, None], six[:, 3:], six[:, :3], six)
    scores = []
    for basis in directions:
        weighted = basis.T @ information
        left = error - basis @ np.linalg.solve(weighted @ basis, weighted @ error)
        scores.append(left @ information @ left + _PARAMETER * basis.shape[1])
    return _CAUSES[int(np.argmin(scores))].format(mount_named(first.mount).parent)


def _spread(values: Array) -> Pair:
    median, most = np.quantile(values, (0.5, 0.9)).tolist()
    return median, most
