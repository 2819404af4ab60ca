"""`FramedPose`: the pose of a camera between two named frames, as other programs take it."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from evercal.classes import frozen
from evercal.errors import InputError
from evercal.geometry import SE3, Camera, UncertainPose
from evercal.robot.frame_names import UNKNOWN, FrameNames
from evercal.robot.mount import MountName, mount_named
from evercal.typing import Array, JsonObject


@frozen
class ImageUse:
    """Use of one image or pose pair."""

    name: str
    used: bool
    reason: str = ""
    """Reason for leaving it out; empty if it was used."""
    residual_mm: float | None = None
    """Distance of its translation from the prediction; `residual_deg` of its rotation."""
    residual_deg: float | None = None


@frozen
class JointOffset:
    """Offset of a joint of the arm, which is to be added to the values that the robot reports."""

    name: str
    """Name of the joint in the URDF."""
    offset: float
    """Radians, or metres of a sliding joint."""
    sigma: float
    """Standard deviation; that before any image where the offset is not determined."""
    is_angle: bool = True
    open: str = ""
    """Why it is not determined, and what would; empty if it is."""

    @property
    def unit(self) -> tuple[str, float]:
        """Unit for people, deg or mm, and how many of it make a radian or a metre."""
        return ("deg", 180 / np.pi) if self.is_angle else ("mm", 1000.0)


@dataclass(frozen=True, eq=False)
class FramedPose:
    """Pose of a camera: `parent_from_child`."""

    mount: MountName
    """`eye_to_hand`: the camera stands still. `eye_in_hand`: the gripper carries it."""
    parent_from_child: SE3
    covariance: Array
    """(6, 6) of (translation in the parent frame, metres; rotation about child axes, radians)."""
    frames: FrameNames = UNKNOWN
    """Names of base, gripper and the camera's optical frame: x right, y down, z forward."""
    camera: Camera | None = None
    """Intrinsics that the pose belongs to: with others, its rays are others. See `for_lens`."""
    images: tuple[ImageUse, ...] = ()
    """All images in the given order."""
    joints: tuple[JointOffset, ...] = field(default=(), kw_only=True)
    """Offsets of the k joints of the arm, if its joint values were stated. The transform is that of
    an arm that moves with them."""
    joint_covariance: Array = field(
        default_factory=lambda: np.zeros((0, 0)), kw_only=True
    )
    """(k, k) of the offsets."""
    lenses: Mapping[str, Camera] = field(default_factory=dict, kw_only=True)
    """Intrinsics of this camera by their origin: `stated` with the images, and `estimated`."""

    @property
    def on_gripper(self) -> bool:
        """Whether the gripper carries the camera; otherwise it stands still in the base."""
        return mount_named(self.mount).moves

    @property
    def parent_frame(self) -> str:
        """Name of base (eye_to_hand) or gripper (eye_in_hand); this word if it is unknown."""
        role = mount_named(self.mount).parent
        return getattr(self.frames, role) or role

    @property
    def child_frame(self) -> str:
        """Name of the camera's optical frame; `camera` if it is unknown."""
        return self.frames.camera or "camera"

    @property
    def meaning(self) -> str:
        """The direction in words."""
        child = self.child_frame
        parent = self.parent_frame
        return f"pose of {child} in {parent}: takes points from {child} to {parent}"

    @property
    def uncertain_pose(self) -> UncertainPose:
        """`parent_from_child` with its covariance."""
        return UncertainPose(self.parent_from_child, self.covariance)

    @property
    def lens(self) -> str:
        """Name of the intrinsics that the pose belongs to, see `lenses`; empty if unknown."""
        return next((k for k, own in self.lenses.items() if own == self.camera), "")

    @property
    def lens_in_words(self) -> str:
        """The intrinsics that the pose belongs to; empty without any."""
        own = self.camera
        if not own:
            return ""
        numbers = f"fx {own.fx:.3f} fy {own.fy:.3f} cx {own.cx:.3f} cy {own.cy:.3f} px"
        if own.distortion:
            terms = " ".join(map("{:.6g}".format, own.distortion))
            numbers = f"{numbers}, distortion {terms}"
        name = self.lens or "camera's"
        return f"the {name} intrinsics {numbers}"

    @property
    def stated_left_rad(self) -> float:
        """Angle by which rays of the stated intrinsics leave the estimated ones, whatever the pose.

        Root mean square over the middle of the image; 0 if nothing is stated or estimated.
        """
        if not {"stated", "estimated"} <= self.lenses.keys():
            return 0.0
        from evercal.geometry.rays import fit_rays

        left = fit_rays(self.lenses["estimated"], self.lenses["stated"]).left_rad
        return float(np.sqrt((left**2).mean()))

    def for_lens(self, lens: Camera | str) -> Self:
        """The pose for other intrinsics: a name in `lenses`, or `given` ones.

        Principal point and distortion trade against a rotation. So the pose is turned until its
        rays agree best with those of before, over the middle of the image.

        Raises:
            InputError: The calibration has no such intrinsics, or their images differ in size.
        """
        from evercal.geometry.rays import fit_rays

        lenses = dict(self.lenses)
        if isinstance(lens, Camera):
            lenses["given"] = lens
        elif lens not in lenses:
            known = ", ".join(lenses) or "no other intrinsics"
            raise InputError(f"`lens` {lens}: this calibration has {known}")
        else:
            lens = lenses[lens]
        if not self.camera:
            raise InputError("`lens`: this calibration holds no intrinsics")
        try:
            turn = fit_rays(self.camera, lens).own_from_other
        except ValueError as error:
            raise InputError(str(error)) from None
        moved = self.uncertain_pose @ SE3.of(turn, np.zeros(3))
        return replace(
            self,
            parent_from_child=moved.pose,
            covariance=moved.covariance,
            camera=lens,
            lenses=lenses,
        )

    def for_program(self) -> Self:
        """The pose for the intrinsics that other programs use: the stated ones, if any."""
        if "stated" in self.lenses:
            return self.for_lens("stated")
        return self

    def transform_to_dict(self) -> JsonObject:
        """Return JSON values of the transform."""
        return {
            "parent_frame": self.parent_frame,
            "child_frame": self.child_frame,
            "meaning": self.meaning,
            "translation_m": self.parent_from_child.translation_m.tolist(),
            "quaternion_wxyz": self.parent_from_child.rotation_wxyz.tolist(),
            "matrix": self.parent_from_child.matrix().tolist(),
            "covariance": self.covariance.tolist(),
            "lens": self.lens,
            "camera": self.camera.to_dict() if self.camera else None,
        }
