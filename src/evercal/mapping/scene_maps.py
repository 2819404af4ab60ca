"""What a store holds in memory: networks, heads, keyframes and a record of every scene."""

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
import torch
from torch import Tensor, nn

from evercal.continual.networks.atlas import Atlas, Cell
from evercal.continual.networks.descriptor import Descriptor
from evercal.continual.networks.head import Head
from evercal.features.device import device_of_network
from evercal.features.encoder import Encoder
from evercal.geometry.camera import Camera
from evercal.geometry.pose_covariance import cross_matrix, with_translation_by
from evercal.geometry.se3 import SE3
from evercal.mapping.frame_correction import FrameCorrection
from evercal.mapping.keyframes import Keyframes

MAX_PROTOTYPES = 256


@dataclass(frozen=True, eq=False)
class Alignment:
    """Where a map that was made in a frame of its own lies in the robot's base frame."""

    base_from_map: SE3
    """Applied after scaling."""
    scale: float = 1.0
    """Metres for every unit of length of the map."""

    def pose(self, map_from_camera: SE3) -> SE3:
        """A camera pose in the base frame."""
        scaled = SE3(map_from_camera.rotation_wxyz, self.scale * map_from_camera.translation_m)
        return self.base_from_map @ scaled

    def map_pose(self, base_from_camera: SE3) -> SE3:
        """A camera pose in the map's own frame: the reverse of `pose`."""
        scaled = self.base_from_map.inverse() @ base_from_camera
        return SE3(scaled.rotation_wxyz, scaled.translation_m / self.scale)

    def points(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) in the base frame."""
        return self.base_from_map.apply(self.scale * points)

    def covariance(self, covariance: np.ndarray) -> np.ndarray:
        """(6, 6) of translation in the base frame and rotation about camera axes."""
        turned = self.scale * self.base_from_map.rotation_matrix()
        return with_translation_by(turned, covariance)


@dataclass(frozen=True)
class SceneRecord:
    """What stays known of a learned scene beside the head's weights."""

    name: str
    """Unique in a store."""
    camera: Camera
    """Intrinsics of its first training frame."""
    cell: Cell
    """Its place in the atlas."""
    prototypes: Tensor
    """(p, width) descriptors of training frames spread over the recording, half precision."""
    train_frames: int
    """Frames it was learned from."""
    refined_camera: Camera | None = None
    """`camera` as training corrected it, with distortion; None where the given one is trusted."""
    inlier_threshold: float = 0.0
    """Poses with a smaller inlier ratio are `unknown_scene`; fitted on held-out training frames."""
    covariance_scale: float = 1.0
    """What covariances are multiplied with to match the errors on held-out training frames."""
    min_support: float = 0.0
    """Poses of the map with less support are `unknown_scene` (`localization.acceptance`)."""
    common: SE3 = field(default_factory=SE3.identity)
    """What the map's poses were multiplied with to become consistent: answers are taken back."""
    map_sigma: tuple[float, float] = (0.0, 0.0)
    """Standard deviation of the map's own poses per axis: metres and radians."""

    bend: FrameCorrection | None = None
    """Corrections of stated poses that go together in places; answers take them back too."""
    frame_covariance: np.ndarray | None = None
    """(6, 6) uncertainty of the base frame itself: a small motion of it, base frame, metres and
    radians, that all answers share. None where poses were stated in it."""
    alignment: Alignment | None = None
    """From the frame that the recording states to the robot's base frame; None if it is that."""

    def stated(self, pose: SE3, covariance: np.ndarray | None) -> tuple[SE3, np.ndarray | None]:
        """A pose of the map in the frame that the recording states, and its covariance.

        Args:
            pose: base_from_camera as the map has it.
            covariance: (6, 6) of translation in the base frame and rotation about camera axes, from
                the image alone.
        """
        if covariance is not None:
            own = np.repeat(np.square(self.map_sigma), 3)
            covariance = covariance * self.covariance_scale + np.diag(own)
        found = pose @ self.common.inverse()
        if self.bend is not None:
            back = SE3.exp(-self.bend.at(found))
            found = pose @ back @ self.common.inverse()
        if self.alignment is not None:
            found = self.alignment.pose(found)
            if covariance is not None:
                covariance = self.alignment.covariance(covariance)
        if covariance is not None and self.frame_covariance is not None:
            covariance = covariance + moved_by_frame(found, self.frame_covariance)
        return found, covariance

    def stated_points(self, points_m: np.ndarray | None) -> np.ndarray | None:
        """Landmarks (n, 3) of the map in the base frame."""
        if points_m is None or self.alignment is None:
            return points_m
        return self.alignment.points(points_m)

    def camera_among_landmarks(self, base_from_camera: SE3) -> SE3:
        """The pose at which a camera that was located sees the landmarks in the base frame.

        The reverse of `stated`, for landmarks from `stated_points`.
        """
        stated = base_from_camera
        if self.alignment is not None:
            stated = self.alignment.map_pose(base_from_camera)
        pose = stated @ self.common
        if self.bend is not None:
            # The bend is told by the pose that is sought; it changes little over its own size.
            for _ in range(3):
                bend = SE3.exp(self.bend.at(pose @ self.common.inverse()))
                pose = stated @ self.common @ bend
        return pose if self.alignment is None else self.alignment.pose(pose)

    def query_camera(self, camera: Camera | None) -> Camera:
        """Intrinsics for a query: refined if the nominal ones or none are given, else as given."""
        if camera is None or (
            np.allclose(_proportions(camera), _proportions(self.camera), atol=1e-3)
            and np.allclose(camera.coefficients, self.camera.coefficients, atol=1e-6)
        ):
            return self.refined_camera or self.camera
        return camera


def moved_by_frame(base_from_camera: SE3, frame_covariance: np.ndarray) -> np.ndarray:
    """(6, 6) covariance of a camera pose that an uncertain base frame gives it.

    Args:
        base_from_camera: single pose.
        frame_covariance: (6, 6) of a small motion (v, w) of the base frame, which moves the
            position t by v + w x t and turns the camera by w.
    """
    slope = np.eye(6)
    slope[:3, 3:] = -cross_matrix(base_from_camera.translation_m)
    slope[3:, 3:] = base_from_camera.rotation_matrix().T
    return slope @ frame_covariance @ slope.T


def frame_moved_by_cameras(base_from_camera: SE3, covariance: np.ndarray) -> np.ndarray:
    """(6, 6) covariance of the base frame that a motion common to all cameras gives it.

    The reverse of `moved_by_frame` for an error of `gripper_from_camera`: landmarks move with the
    cameras that saw them, so the frame moves by the mean over them.

    Args:
        base_from_camera: (n,) poses that a map was built from.
        covariance: (6, 6) of the common motion, camera frame.
    """
    turn = base_from_camera.rotation_matrix()
    slope = np.zeros((len(turn), 6, 6))
    slope[:, :3, :3] = slope[:, 3:, 3:] = turn
    for axis in range(3):  # the position moves by R v, less what turning about the base moves it
        slope[:, :3, 3 + axis] = np.cross(base_from_camera.translation_m, turn[:, :, axis])
    mean = slope.mean(0)
    return mean @ covariance @ mean.T


def _proportions(camera: Camera) -> tuple[float, float, float, float]:
    w, h = camera.width, camera.height
    return camera.fx / w, camera.fy / h, (camera.cx + 0.5) / w, (camera.cy + 0.5) / h


def with_fit(record: SceneRecord, inlier_threshold: float, covariance_scale: float) -> SceneRecord:
    """The record with what was fitted on held-out frames."""
    return replace(record, inlier_threshold=inlier_threshold, covariance_scale=covariance_scale)


def corrected_camera(camera: Camera, correction: Tensor) -> Camera:
    """A nominal pinhole with the correction (5,) that training found (see `reprojection_error`)."""
    focal, dx, dy, k1, k2 = (float(value) for value in correction)
    return Camera(
        camera.width,
        camera.height,
        camera.fx * (1 + focal),
        camera.fy * (1 + focal),
        camera.cx + dx * camera.fx,
        camera.cy + dy * camera.fy,
        (k1, k2, 0.0, 0.0),
    )


def correction_between(nominal: Camera, refined: Camera) -> Tensor:
    """(5,) the correction that makes one camera of the other: the reverse of `corrected_camera`."""
    k1, k2 = refined.distortion[:2] or (0.0, 0.0)
    shift = (refined.cx - nominal.cx) / nominal.fx, (refined.cy - nominal.cy) / nominal.fy
    return torch.tensor([refined.fx / nominal.fx - 1, *shift, k1, k2])


@dataclass
class SceneMaps:
    """Everything that localization and the next stage need."""

    encoder: Encoder
    """Frozen local encoder."""
    descriptor: Descriptor
    """Frozen global descriptor."""
    strategy: str
    """Key of STRATEGIES."""
    short_side: int
    """Working size of images, pixels."""
    heads: list[Head] = field(default_factory=list)
    """One head, or one per scene."""
    scenes: list[SceneRecord] = field(default_factory=list)
    """In order of arrival; the index is the scene index of head and atlas."""
    keyframes: list[Keyframes | None] = field(default_factory=list)
    """Of each scene; None where nothing is kept."""
    method_states: list[Mapping[str, Tensor]] = field(default_factory=list)
    """Named tensors that the strategy keeps of each scene (`continual.method_state`)."""

    @property
    def device(self) -> torch.device:
        """Where the encoder's weights lie, and so where images are encoded."""
        return device_of_network(self.encoder)

    def to(self, device: torch.device) -> Self:
        """Moves encoder, descriptor and heads to a device, in place; what is kept stays.

        Keyframes, prototypes and method states stay on the CPU: who uses them moves them.
        """
        for network in (self.encoder, self.descriptor, *self.heads):
            if isinstance(network, nn.Module):
                network.to(device)
        return self

    @property
    def memory_bytes(self) -> int:
        """Size of all that is kept for later stages: keyframes and method states."""
        frames = sum(keyframes.bytes for keyframes in self.keyframes if keyframes is not None)
        return frames + sum(
            value.nbytes for state in self.method_states for value in state.values()
        )

    def atlas(self, grid_scenes: int = 0) -> Atlas:
        """Cells of the scenes known so far.

        Args:
            grid_scenes: of the paper's layout; 0 for the open one.
        """
        atlas = Atlas("paper", grid_scenes) if grid_scenes else Atlas()
        atlas.cells = [record.cell for record in self.scenes]
        return atlas

    def head_for(self, scene: int) -> tuple[Head, int]:
        """The head that answers for a scene and the scene's index in that head."""
        if len(self.heads) == 1 and self.heads[0].scenes > scene:
            return self.heads[0], scene
        return self.heads[scene], 0

    def copy_for_training(self) -> "SceneMaps":
        """A copy whose heads may be trained without touching these."""
        return SceneMaps(
            self.encoder,
            self.descriptor,
            self.strategy,
            self.short_side,
            copy.deepcopy(self.heads),
            list(self.scenes),
            list(self.keyframes),
            list(self.method_states),
        )


def prototypes(descriptors: Tensor) -> Tensor:
    """At most 256 descriptors (n, width), spread evenly over a recording; half, on the CPU."""
    count = min(MAX_PROTOTYPES, len(descriptors))
    index = np.linspace(0, len(descriptors) - 1, count).round().astype(int)
    return descriptors[index].half().cpu()
