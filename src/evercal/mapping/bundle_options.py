"""`BundleOptions`: priors and weights of a bundle adjustment."""

from dataclasses import replace

import numpy as np

from evercal.classes import frozen
from evercal.errors import require_numbers
from evercal.geometry import Camera
from evercal.geometry.distortion import USUAL_DISTORTION
from evercal.mapping.bundle_equations import INTRINSICS
from evercal.typing import Array, Pair

FIXED = 1e-9
"""Prior standard deviation of shared parameters that are not adjusted."""
LENS_SIGMA = (0.005, 0.007)
"""`lens_sigma` of a hand-eye calibration: 0.5 % of the focal length, and for the principal point
about 0.5 % of the width. Files and methods of one camera differ by as much (docs/handeye.md)."""
_MAY_BE_ZERO = ("relevance", "least_share", "least_systematic")
"""Lower bounds that have no effect at 0."""
_LEAST = 1e-12
"""Smallest value of the other numbers, which are divisors."""


@frozen
class BundleOptions:
    """Priors and weights of a bundle adjustment."""

    iterations: int = 10
    """Maximum number of Levenberg-Marquardt steps."""
    start_sigma_m: float = 0.01
    """Standard deviation of stated positions per axis, metres, before it is estimated."""
    start_sigma_deg: float = 0.4
    """The same for stated rotations, degrees."""
    least_sigma_m: float = 5e-5
    """Lower bound of the estimated standard deviation of positions per axis, metres."""
    least_sigma_deg: float = 3e-4
    """The same for rotations, degrees."""
    most_sigma_m: float = 0.1
    """Upper bound of the estimated standard deviation of positions per axis, metres."""
    most_sigma_rad: float = 0.1
    """The same for rotations, radians."""
    common_sigma_m: float = 0.02
    """Prior standard deviation of the common translation per axis, metres."""
    common_sigma_deg: float = 2.0
    """The same for the common rotation, degrees."""
    common_stated: bool = True
    """The common transform stays zero unless the images contradict. False for a rough
    `gripper_from_camera`: the common transform is estimated with its full uncertainty."""
    joint_sigma_deg: float = 3.0
    """Prior standard deviation of the offset of a joint, degrees, before it is estimated."""
    joint_sigma_m: float = 0.01
    """The same for sliding joints, metres."""
    shift_sigma_frames: float = 2.0
    """Prior standard deviation of the time shift, in frames of the recording."""
    focal_sigma: float = 0.02
    """Prior standard deviation of the focal length, as a share of it."""
    centre_sigma_px: float = 5.0
    """Prior standard deviation of the principal point, pixels."""
    distortion_sigma: float = 0.2
    """Prior standard deviation of k1 and k2 where the recording states no distortion."""
    lens_sigma: Pair | None = None
    """Prior standard deviations of an uncertain lens, which stay whatever the images say: of the
    focal length and of the principal point, as shares of the focal length. The distortion is then
    that of an unknown lens. None: intrinsics change only where the images require it."""
    relevance: float = 4.0
    """A group of parameters is adjusted when its squares are this many times their variance."""
    least_share: float = 1e-6
    """Variance that a group keeps where the images require no change, as a share of its prior."""
    least_systematic: float = 0.1
    """Lower bound of the variance of systematic errors of an arm, in variances of the noise."""
    tail: float = 5.0
    """Degrees of freedom of the Student distribution of pose errors, which has heavy tails."""
    correlation: float = 2.0
    """Factor on the standard deviation of observations: alignment errors of neighbouring views are
    correlated."""
    intrinsics: bool = True
    """Adjust the intrinsics."""

    def __post_init__(self) -> None:
        """Refuse numbers outside their range.

        Raises:
            InputError: Fewer than one iteration, a negative number or zero.
        """
        others = {"common_stated", "intrinsics", "lens_sigma", *_MAY_BE_ZERO}
        require_numbers(self, ("iterations",), 1)
        require_numbers(self, _MAY_BE_ZERO, 0)
        require_numbers(self, vars(self).keys() - others, _LEAST)

    def for_hand_eye(self, moves: bool) -> "BundleOptions":
        """The same options for poses from a rough `gripper_from_camera`, whose camera may move.

        The common transform has no prior, and the lens is uncertain. The poses of arms have errors
        of a tenth of a millimetre at least, which bounds the estimated errors of stated poses.
        """
        options = replace(
            self,
            common_stated=False,
            # Before one place, the adjusted mount depends on its start by more than the noise.
            least_systematic=1.0,
            common_sigma_m=0.2,
            common_sigma_deg=10.0,
            lens_sigma=LENS_SIGMA,
            least_sigma_m=2e-4,
            least_sigma_deg=0.015,
        )
        if moves:
            return options
        return replace(
            options,
            least_systematic=0.1,
            correlation=2.7,
            least_share=0.0025,
            least_sigma_m=1e-4,
            least_sigma_deg=0.01,
        )

    def intrinsics_sigma(self, camera: Camera) -> Array:
        """Prior standard deviations (8,) of the intrinsics, in the order of `Camera.slopes`."""
        sigma = np.full(INTRINSICS, FIXED)
        if not self.lens_sigma:
            sigma[0] = self.focal_sigma
            sigma[1:3] = self.centre_sigma_px
            if not any(camera.distortion):
                sigma[3:5] = self.distortion_sigma
            return sigma
        focal, centre = self.lens_sigma
        sigma[0] = focal
        sigma[1:3] = centre * camera.fx
        terms = USUAL_DISTORTION[camera.model]
        sigma[3 : 3 + len(terms)] = terms
        return sigma
