"""`MapFrame`: from the frame that a map was adjusted in to the robot's base frame, and back.

Bundle adjustment changes the stated poses of a recording. Three parts of that change are errors of
the map's frame and not of single frames, so localization undoes them:

- a transform common to all cameras: an error of `gripper_from_camera` or of the sensor that stated
  the poses;
- corrections that vary slowly over the recording: a drifting depth fusion, an arm that sags;
- the similarity of a map whose own frame or unit is not that of the base.

Slow corrections are predicted from neighbouring frames. Noise cannot be predicted and remains.
"""

from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evercal.classes import frozen_arrays
from evercal.geometry import SE3, UncertainPose, norms, pose_to_dict
from evercal.typing import Array, JsonObject, Pair, Record

RADII = ((0.1, 10.0), (0.2, 15.0), (0.4, 25.0))
"""Candidate correlation lengths of corrections, metres and degrees."""
MIN_EXPLAINED = 0.3
"""Share of the corrections' variance that neighbours must explain."""
LEAST_CORRECTION_M = 1e-4
"""Smaller mean corrections of positions are not predicted, metres."""
LEAST_CORRECTION_RAD = 1e-5
"""The same for rotations, radians."""
SHRINKAGE = 0.3
"""A zero correction counts as this many neighbours."""


@frozen_arrays
class FrameCorrection:
    """Slowly varying corrections of the stated poses."""

    poses: SE3
    """(n,) base_from_camera as adjusted, without the common transform."""
    correction: Array
    """(n, 6) in the camera frame, metres and radians."""
    radius: Pair
    """Correlation length, metres and radians."""

    def at(self, pose: SE3) -> Array:
        """(6,) correction of a camera at a pose in the frame of `poses`."""
        weight = _closeness(self.poses, pose, self.radius)
        return (weight[:, None] * self.correction).sum(0) / (weight.sum() + SHRINKAGE)


@frozen_arrays
class Similarity:
    """Transform from a map with a frame and scale of its own to the robot's base frame."""

    base_from_map: SE3
    """Applied after scaling."""
    scale: float = 1.0
    """Units of length of the base frame per unit of the map."""
    metric: bool = True
    """Whether the base frame is in metres. Otherwise this leads to the recording's own unit."""

    def pose(self, map_from_camera: SE3) -> SE3:
        """Camera pose in the base frame."""
        translation = self.scale * map_from_camera.translation_m
        return self.base_from_map @ SE3(map_from_camera.rotation_wxyz, translation)

    def inverse_pose(self, base_from_camera: SE3) -> SE3:
        """Camera pose in the map's own frame."""
        scaled = self.base_from_map.inverse() @ base_from_camera
        return SE3(scaled.rotation_wxyz, scaled.translation_m / self.scale)

    def points(self, points: Array) -> Array:
        """Points (..., 3) in the base frame, metres."""
        return self.base_from_map.apply(self.scale * points)


@frozen_arrays
class MapFrame:
    """Relation of a map's own frame to the robot's base frame."""

    common: SE3 = field(default_factory=SE3.identity)
    """stated_camera_from_camera: adjusted poses are stated poses times this."""
    correction: FrameCorrection | None = None
    """Slowly varying corrections; None if neighbours do not predict them."""
    pose_sigma: Pair = (0.0, 0.0)
    """Standard deviation of the adjusted poses per axis, metres and radians."""
    frame_sigma: Pair = (0.0, 0.0)
    """Standard deviation of the stated frame about the map per axis, metres and radians: errors of
    the stated poses that neighbouring frames share, see `shared_sigma`."""
    similarity: Similarity | None = None
    """From the frame of the recording to the base frame; None if both are the same."""
    base_covariance: Array | None = None
    """(6, 6) of a small motion of the base frame that is common to all answers, metres and radians.
    None for poses that were stated in the base frame."""

    def to_base(self, map_from_camera: UncertainPose) -> UncertainPose:
        """Transform a pose that was estimated from landmarks to the base frame.

        The errors of the map's poses, of the stated frame and of the base frame are added to the
        covariance.
        """
        variance = np.square(self.pose_sigma) + np.square(self.frame_sigma)
        covariance = map_from_camera.covariance + np.diag(np.repeat(variance, 3))
        pose = self._undo(map_from_camera.pose)
        if self.similarity:
            pose = self.similarity.pose(pose)
            covariance = self.slope @ covariance @ self.slope.T
        estimate = UncertainPose(pose, covariance)
        if self.base_covariance is None:
            return estimate
        return UncertainPose(SE3.identity(), self.base_covariance) @ estimate

    @property
    def shared_m(self) -> float:
        """Root mean square per axis of errors of stated positions that neighbours share."""
        if not self.correction:
            return self.frame_sigma[0]
        return float(np.sqrt((self.correction.correction[:, :3] ** 2).mean()))

    @property
    def scale(self) -> float:
        """Units of length of an answer per unit of the map."""
        return self.similarity.scale if self.similarity else 1.0

    @property
    def slope(self) -> Array:
        """(6, 6) derivative of an answer by a pose among the landmarks."""
        slope = np.eye(6)
        if self.similarity:
            rotation = self.similarity.base_from_map.rotation_matrix()
            slope[:3, :3] = self.similarity.scale * rotation
        return slope

    def from_base(self, base_from_camera: SE3) -> SE3:
        """Camera pose among the landmarks: the inverse of `to_base`."""
        stated = base_from_camera
        if self.similarity:
            stated = self.similarity.inverse_pose(base_from_camera)
        pose = stated @ self.common
        if self.correction:
            # The correction depends on the pose that is sought, and varies little over its size.
            for _ in range(3):
                correction = self.correction.at(pose @ self.common.inverse())
                pose = stated @ self.common @ SE3.exp(correction)
        return pose

    def points_to_base(self, points_m: Array) -> Array:
        """Landmarks (n, 3) in the base frame."""
        return self.similarity.points(points_m) if self.similarity else points_m

    def camera_among_points(self, base_from_camera: SE3) -> SE3:
        """The pose at which a located camera observes landmarks from `points_to_base`.

        It differs from the answer by the corrections that `to_base` undoes.
        """
        pose = self.from_base(base_from_camera)
        return self.similarity.pose(pose) if self.similarity else pose

    def _undo(self, pose: SE3) -> SE3:
        stated = pose @ self.common.inverse()
        if not self.correction:
            return stated
        return pose @ SE3.exp(-self.correction.at(stated)) @ self.common.inverse()


def frame_covariance(base_from_camera: SE3, covariance: Array) -> Array:
    """Covariance of the base frame from a motion that is common to all cameras of a map.

    Landmarks move with the cameras that observe them, so an error of `gripper_from_camera`, (6, 6)
    in the camera frame, moves the frame of the map by the mean over its cameras.
    """
    mean = base_from_camera.adjoint().mean(0)
    return mean @ covariance @ mean.T


def fit_correction(poses: SE3, correction: Array) -> FrameCorrection | None:
    """Fit the correlation length of corrections.

    Corrections (n, 6) are without the common transform and the time shift. Returns None if
    neighbours explain too little of them.
    """
    size = np.abs(correction)
    metres = size[:, :3].mean()
    radians = size[:, 3:].mean()
    if metres < LEAST_CORRECTION_M or radians < LEAST_CORRECTION_RAD:
        return None
    scale = np.repeat([metres, radians], 3)
    total = float(((correction / scale) ** 2).sum())
    most_explained = MIN_EXPLAINED
    best = None
    for metres, degrees in RADII:
        radius = (metres, float(np.deg2rad(degrees)))
        left = correction - _left_out(poses, correction, radius)
        explained = 1 - float(((left / scale) ** 2).sum()) / total
        if explained > most_explained:
            most_explained = explained
            best = FrameCorrection(poses, correction, radius)
    return best


def shared_sigma(
    poses: SE3,
    correction: Array,
    fitted: FrameCorrection | None,
) -> Pair:
    """Standard deviation per axis of stated poses whose errors neighbouring frames share.

    Poses and corrections (n, 6) are those of `fit_correction`, in recorded order; `fitted` is its
    result. Independent errors of stated poses average out in a map and give 0: successive
    corrections are uncorrelated to within three standard errors.
    """
    if len(correction) < 4:
        return 0.0, 0.0
    left = correction
    if fitted:
        left = correction - _left_out(poses, correction, fitted.radius)
    metres = _shared(correction[:, :3], left[:, :3])
    radians = _shared(correction[:, 3:], left[:, 3:])
    return metres, radians


def _shared(correction: Array, left: Array) -> float:
    """`shared_sigma` of three axes (n, 3), by what neighbours leave of the corrections."""
    shared = float((left[:-1] * left[1:]).mean())
    error = float((left**2).mean()) / np.sqrt(left[1:].size)
    if shared <= 3 * error:
        return 0.0
    return float(np.sqrt((correction**2).mean()))


def _left_out(
    poses: SE3,
    correction: Array,
    radius: Pair,
) -> Array:
    """(n, 6) corrections that the other frames predict."""
    rows = [_closeness(poses, pose, radius) for pose in poses]
    weight = np.stack(rows)
    np.fill_diagonal(weight, 0)
    return weight @ correction / (weight.sum(1, keepdims=True) + SHRINKAGE)


def _closeness(
    poses: SE3,
    pose: SE3,
    radius: Pair,
) -> Array:
    """(n,) Gaussian weights of poses by their distance to one pose."""
    metres = norms(poses.translation_m - pose.translation_m)
    cosine = np.abs(poses.rotation_wxyz @ pose.rotation_wxyz).clip(0, 1)
    angle = 2 * np.arccos(cosine)
    far = metres / radius[0]
    turned = angle / radius[1]
    return np.exp(-0.5 * far**2 - 0.5 * turned**2)


def frame_to_dict(frame: MapFrame) -> JsonObject:
    """A map's frame as JSON values, without its slowly varying corrections."""
    base = None
    similarity = frame.similarity
    if similarity:
        base = similarity.base_from_map
    covariance = frame.base_covariance
    return {
        "stated_camera_from_camera": pose_to_dict(frame.common),
        "pose_sigma": list(frame.pose_sigma),
        "frame_sigma": list(frame.frame_sigma),
        "base_from_map": pose_to_dict(base),
        "scale": frame.scale,
        "unit_known": similarity is None or similarity.metric,
        "base_covariance": None if covariance is None else covariance.tolist(),
    }


def frame_of(content: Record, correction: FrameCorrection | None) -> MapFrame:
    """The inverse of `frame_to_dict`."""
    base = content["base_from_map"]
    covariance = content["base_covariance"]
    if covariance is not None:
        covariance = np.asarray(covariance, float)
    similarity = None
    if base is not None:
        metric = bool(content.get("unit_known", True))
        similarity = Similarity(stored_pose(base), float(content["scale"]), metric)
    return MapFrame(
        common=stored_pose(content["stated_camera_from_camera"]),
        correction=correction,
        pose_sigma=_pair(content["pose_sigma"]),
        frame_sigma=_pair(content["frame_sigma"]),
        similarity=similarity,
        base_covariance=covariance,
    )


def _pair(values: Sequence[float]) -> Pair:
    return float(values[0]), float(values[1])


def stored_pose(values: Any) -> SE3:
    """A stored pose to its last bit; maps of earlier versions hold a matrix, which rounds it."""
    if isinstance(values, list):
        return SE3.from_matrix(np.asarray(values))
    return SE3(values["quaternion_wxyz"], values["translation_m"])


def correction_tensors(correction: FrameCorrection) -> dict[str, NDArray[Any]]:
    """Slowly varying corrections as named arrays."""
    rows = [correction.poses.rotation_wxyz, correction.poses.translation_m]
    return {
        "poses": np.concatenate(rows, -1),
        "correction": np.asarray(correction.correction),
        "radius": np.asarray(correction.radius, float),
    }


def correction_of(tensors: Mapping[str, NDArray[Any]]) -> FrameCorrection:
    """The inverse of `correction_tensors`."""
    rows = tensors["poses"]
    poses = SE3(rows[:, :4], rows[:, 4:])
    radius = _pair(tensors["radius"].tolist())
    return FrameCorrection(poses, tensors["correction"], radius)
