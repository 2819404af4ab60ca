"""What a calibration was compared with, in the order of its JSON."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Self

from evercal.typing import JsonObject, Record

Numbers = Mapping[str, float]
Pose = Record
"""JSON values of a pose, see `geometry.pose_to_dict`."""


@dataclass(frozen=True, kw_only=True)
class Checks:
    """Values of all origins; None where an origin has no such value."""

    images_given: int | None = None
    images_used: int | None = None
    """Number of images that `image_scatter` was measured with."""
    image_scatter: Sequence[Sequence[float]] | None = None
    """(6, 6) covariance of the pose from a single image about the others."""
    joints_move_mm: Sequence[float] | None = None
    """Mean and largest displacement of the gripper by the offsets of the joints."""
    poses_given: int | None = None
    poses_used: int | None = None
    residual_mm: float | None = None
    """Root mean square distance of the poses used from their prediction."""
    residual_deg: float | None = None
    held_out_mm: float | None = None
    """Median distance of held-out poses from their prediction."""
    held_out_deg: float | None = None
    held_out_rms_mm: float | None = None
    held_out_rms_deg: float | None = None
    held_out_sigmas: float | None = None
    """Root mean square error of held-out poses per axis, in stated standard deviations."""
    repeatability_mm: float | None = None
    """Distance between the calibrations from two halves of the data."""
    repeatability_deg: float | None = None
    target_m: float | None = None
    """Median distance between camera and board."""
    base_from_board: Pose | None = None
    """Estimated pose of the board of a camera on the gripper."""
    gripper_from_board: Pose | None = None
    """Estimated pose of the board of a fixed camera."""
    leave_one_out_mm: Numbers | None = None
    """Displacement of the calibration without an image, by its name."""
    information_percent: Numbers | None = None
    """Share of an image in the information, by its name."""
    camera_from_board: Mapping[str, Pose] | None = None
    """Board pose in each image by the calibration and the robot's poses."""
    left_open: Sequence[str] | None = None
    """What the poses determine badly, one sentence each."""
    warnings: Sequence[str] | None = None
    """What the data contradict, one sentence each."""
    time_offset_s: float | None = None
    """Offset to add to the stamp of an image."""
    time_offset_sigma_s: float | None = None
    scale: float | None = None
    """Metres per unit of the board's lengths."""
    scale_sigma: float | None = None
    corner_sigma_px: float | None = None
    """Standard deviation of the corners."""
    corners_left_out: Sequence[str] | None = None
    """Corners that leave their neighbours: image, x, y."""
    camera_sigma: Numbers | None = None
    """Standard deviations of the estimated intrinsics."""
    outline_confirmed: float | None = None
    """Share of the outline of an arm that the images show, 0 to 1."""
    outline_sigma_px: float | None = None
    """Robust standard deviation of the outlines."""
    other: Record = field(default_factory=dict)
    """Values of files that other programs wrote."""

    def to_dict(self) -> JsonObject:
        """Return JSON values; those that are None are left out."""
        values = dict(vars(self))
        other = values.pop("other")
        known = {name: value for name, value in values.items() if value is not None}
        return {**known, **other}

    @classmethod
    def from_dict(cls, values: Record) -> Self:
        """The inverse of `to_dict`."""
        names = {item.name for item in fields(cls)} - {"other"}
        known = {name: value for name, value in values.items() if name in names}
        other = {name: value for name, value in values.items() if name not in names}
        return cls(**known, other=other)
