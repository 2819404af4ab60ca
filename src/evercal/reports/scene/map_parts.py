"""What is shown of a scene: landmarks with colours, and keyframes; arrays in the base frame.

Landmarks and keyframes are shown as the map was adjusted. Answers differ from that frame by the
corrections of `mapping.map_frame`, usually about a millimetre.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from evercal.geometry import Camera
from evercal.mapping.scene_map import SceneMap
from evercal.reports.overlay import colour_map
from evercal.reports.overlay import resized as resized
from evercal.reports.scene.frusta import Frustum

Array = NDArray[np.floating]
Image = NDArray[np.uint8]
ColourBy = Literal["image", "height", "uncertainty"]

MOST_POINTS = 50_000
"""Landmarks that are shown of all scenes together; more are thinned out evenly."""
THUMBNAIL_PX = 160
"""Width of the image in a frustum."""


@dataclass(frozen=True, eq=False)
class Landmarks3D:
    """The landmarks of a scene."""

    points_m: Array
    """(n, 3) in the base frame, metres."""
    grey: Image
    """(n,) the pixel of its keyframe."""
    sigma_mm: Array
    """(n,) standard deviation along the viewing ray of its keyframe, millimetres."""

    @classmethod
    def of(cls, scene: SceneMap, most: int = MOST_POINTS) -> Self:
        """All landmarks, or `most` of them, drawn evenly from all keyframes."""
        keyframes, scale = scene.keyframes, _scale(scene)
        points, grey, sigma = [np.zeros((0, 3))], [np.zeros(0, np.uint8)], [np.zeros(0)]
        for i, marks in enumerate(keyframes.landmarks):
            local = marks.surface(keyframes.cameras[i])[0]
            points.append(scene.frame.points_to_base(keyframes.base_from_camera[i].apply(local)))
            column, row = np.round(marks.pixels).astype(int).T
            grey.append(keyframes.grey(i)[row, column])
            # The error of a depth 1 / d is sigma / d^2; along the ray it is as much longer.
            along = np.linalg.norm(local, axis=1) * marks.sigma / marks.inverse_depth
            sigma.append(1000 * scale * along)
        joined = np.concatenate(points)
        valid = np.flatnonzero(np.isfinite(joined).all(1))
        if len(valid) > most:
            valid = valid[np.linspace(0, len(valid) - 1, most).round().astype(int)]
        return cls(joined[valid], np.concatenate(grey)[valid], np.concatenate(sigma)[valid])

    def __len__(self) -> int:
        return len(self.points_m)

    def colours(self, by: ColourBy) -> Image:
        """(n, 3) RGB: the pixel of the image, or viridis of the height or of the uncertainty."""
        if by == "image":
            return np.repeat(self.grey[:, None], 3, axis=1)
        sigma = np.log(np.maximum(self.sigma_mm, 1e-6))
        values = np.asarray(self.points_m[:, 2] if by == "height" else sigma, np.float64)
        if not len(values):
            return np.zeros((0, 3), np.uint8)
        low, high = np.percentile(values, [2, 98]).tolist()
        return colour_map(values, (low, high))


@dataclass(frozen=True, eq=False)
class KeyframeView:
    """A keyframe of a scene."""

    scene: str
    number: int
    frustum: Frustum
    camera: Camera
    """Intrinsics at the size of `image`."""
    image: Image
    """(h, w, 3) RGB at working size."""
    depths_m: Array
    """(n,) depths of its landmarks along the optical axis."""

    @property
    def backdrop(self) -> "Backdrop":
        """The image as a plane behind nearly all of its landmarks."""
        depth = 1.05 * float(np.percentile(self.depths_m, 98)) if len(self.depths_m) else 1.0
        camera = self.camera
        width, height = depth * camera.width / camera.fx, depth * camera.height / camera.fy
        middle = np.array([(camera.width - 1) / 2, (camera.height - 1) / 2])
        ahead = np.append((middle - (camera.cx, camera.cy)) / (camera.fx, camera.fy), 1.0)
        return Backdrop(self.frustum.base_from_camera.apply(depth * ahead), width, height)


class Backdrop(NamedTuple):
    """A rectangle parallel to an image, in which a camera without distortion sees the image."""

    centre_m: Array
    """(3,) in the base frame."""
    width_m: float
    height_m: float


def keyframe_views(scene: SceneMap) -> list[KeyframeView]:
    """All keyframes of a scene, with poses among the landmarks as they are shown."""
    keyframes, scale, views = scene.keyframes, _scale(scene), []
    for i, camera in enumerate(keyframes.cameras):
        pose, marks = keyframes.base_from_camera[i], keyframes.landmarks[i]
        if scene.frame.similarity is not None:
            pose = scene.frame.similarity.pose(pose)
        image = np.repeat(keyframes.grey(i)[..., None], 3, axis=-1)
        frustum, depths = Frustum.of(pose, camera), scale / marks.inverse_depth
        views.append(KeyframeView(scene.name, i, frustum, camera, image, depths))
    return views


def _scale(scene: SceneMap) -> float:
    return 1.0 if scene.frame.similarity is None else scene.frame.similarity.scale
