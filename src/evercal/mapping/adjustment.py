"""`Adjustment`: the result of bundle adjustment."""

from dataclasses import dataclass

from evercal.geometry import SE3, Camera
from evercal.mapping.bundle_equations import COMMON
from evercal.typing import Array, BoolArray


@dataclass(frozen=True, eq=False)
class Adjustment:
    """Result of bundle adjustment."""

    poses: SE3
    """(n,) base_from_camera of the frames."""
    cameras: list[Camera] | None
    """(n,) adjusted intrinsics; None where lenses differ or nothing was adjusted."""
    common: SE3
    """stated_camera_from_camera: stated poses are corrected by this on the right."""
    shift_frames: float
    """Delay of the images after their stated poses, in frames."""
    sigma_m: float
    """Estimated standard deviation of stated positions per axis, metres."""
    sigma_rad: float
    """The same for stated rotations, radians."""
    residual_px: float
    """Median reprojection error, pixels."""
    lens_covariance: Array
    """(14, 14) of the common transform, camera frame, metres and radians, and the intrinsics."""
    lens_systematic: Array
    """(14, 14) of the same, due to errors of stated poses that vary linearly over the recording."""
    correction: Array
    """(n, 6) of each pose beside common transform and time shift, camera frame, metres and
    radians."""
    errors: Array
    """(n, 6) the same where the errors of stated poses arise, see `StatedErrors`."""
    weight: Array
    """(n,) below 1 for stated poses with larger errors than most."""
    covariance: Array
    """(n, 6, 6) of the adjusted poses, camera frame."""
    inverse_depth: Array
    """(p,) per metre."""
    offsets: Array
    """(k,) offsets of the joints of an arm, radians, or metres of sliding joints."""
    offsets_covariance: Array
    """(k, k) with systematic errors."""
    offsets_prior: Array
    """(k,) estimated standard deviation of the offsets of this arm."""
    offsets_known: BoolArray
    """(k,) whether the images tell an offset better than the first prior."""

    @property
    def common_covariance(self) -> Array:
        """(6, 6) of the common transform, camera frame, metres and radians."""
        return self.lens_covariance[:COMMON, :COMMON]

    @property
    def common_systematic(self) -> Array:
        """(6, 6) of the same, due to errors of stated poses that vary linearly."""
        return self.lens_systematic[:COMMON, :COMMON]
