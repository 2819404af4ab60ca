"""Cameras and maps in the scene of a page."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import viser

from evercal.geometry import SE3
from evercal.mapping.scene_map import SceneMap
from evercal.reports.scene.frusta import Frustum
from evercal.reports.scene.map_parts import (
    THUMBNAIL_PX,
    ColourBy,
    KeyframeView,
    Landmarks3D,
    keyframe_views,
    resized,
    shares,
)
from evercal.service.viewer.html import GREY, Colour

OnKeyframe = Callable[[KeyframeView, viser.ClientHandle], Any]


def add_frustum(
    server: viser.ViserServer,
    name: str,
    frustum: Frustum,
    size_m: float,
    colour: Colour,
    image: np.ndarray | None = None,
) -> viser.CameraFrustumHandle:
    """Add a camera with its image to the scene."""
    return server.scene.add_camera_frustum(
        name,
        frustum.fov_rad,
        frustum.aspect,
        scale=size_m,
        thickness=2.0,
        thickness_units="screen",
        color=colour,
        image=None if image is None else resized(image, THUMBNAIL_PX),
        wxyz=frustum.base_from_camera.rotation_wxyz,
        position=frustum.base_from_camera.translation_m,
        cast_shadow=False,
        receive_shadow=False,
    )


def place(node: viser.SceneNodeHandle, base_from_node: SE3) -> None:
    """Move a node of the scene."""
    node.wxyz, node.position = base_from_node.rotation_wxyz, base_from_node.translation_m


def add_base(server: viser.ViserServer, side_m: float) -> None:
    """Add the axes of the robot base, and a floor with cells of 10 cm."""
    server.scene.add_frame("/base", axes_length=0.05 * side_m, axes_radius=0.0015 * side_m)
    server.scene.add_label("/base/label", "robot base")
    server.scene.add_grid(
        "/floor",
        side_m,
        side_m,
        cell_size=0.1,
        cell_color=(60, 66, 76),
        section_color=(80, 87, 99),
        shadow_opacity=0.0,
    )


class DrawnMap:
    """Landmarks and keyframes of all scenes; a map that was drawn before is replaced."""

    def __init__(
        self,
        server: viser.ViserServer,
        scenes: Sequence[SceneMap],
        on_keyframe: OnKeyframe = lambda *_: None,
    ):
        self._server, self._on_keyframe = server, on_keyframe
        self.names = [scene.name for scene in scenes]
        most = shares([scene.landmarks for scene in scenes])
        self.landmarks = [Landmarks3D.of(scene, n) for scene, n in zip(scenes, most, strict=True)]
        self.keyframes = [keyframe_views(scene) for scene in scenes]
        self.extent_m = _extent(self.landmarks[0].points_m)
        self._frames: list[viser.FrameHandle] = []
        self._clouds: list[viser.PointCloudHandle] = []
        self._cameras: list[viser.CameraFrustumHandle] = []
        server.scene.remove_by_name("/scenes")
        with server.atomic():
            for number in range(len(scenes)):
                self._add(number)
        self.show(self.names[0])

    @property
    def frustum_m(self) -> float:
        """Size of a drawn camera."""
        return 0.03 * self.extent_m

    def show(self, scene: str | None) -> None:
        """Show one scene, or all of them for None."""
        for name, frame in zip(self.names, self._frames, strict=True):
            frame.visible = scene in (None, name)

    def colour_by(self, by: ColourBy) -> None:
        """Colour the landmarks."""
        for cloud, landmarks in zip(self._clouds, self.landmarks, strict=True):
            cloud.colors = landmarks.colours(by)

    def resize_points(self, size_mm: float) -> None:
        """Draw landmarks with a diameter in millimetres."""
        for cloud in self._clouds:
            cloud.point_size = size_mm / 1000

    def show_keyframes(self, visible: bool) -> None:
        """Show or hide the keyframes."""
        for camera in self._cameras:
            camera.visible = visible

    def look_from_behind(self) -> None:
        """Begin above and behind the keyframes of the first scene."""
        poses = SE3.stack([view.frustum.base_from_camera for view in self.keyframes[0]])
        ahead = poses.rotation_matrix()[:, :, 2].mean(0) * (1, 1, 0)
        target = poses.translation_m.mean(0)
        camera = self._server.initial_camera
        camera.position = target + self.extent_m * (np.array([0, 0, 0.6]) - ahead)
        camera.look_at = target

    def _add(self, number: int) -> None:
        # Nodes are numbered, since names of scenes may hold a slash.
        name, scene, landmarks = f"/scenes/{number}", self._server.scene, self.landmarks[number]
        self._frames.append(scene.add_frame(name, show_axes=False))
        cloud = scene.add_point_cloud(
            f"{name}/landmarks",
            landmarks.points_m.astype(np.float32),
            landmarks.colours("image"),
            point_size=0.003 * self.extent_m,
            point_shape="circle",
            precision="float32",
        )
        self._clouds.append(cloud)
        for view in self.keyframes[number]:
            node, size = f"{name}/{view.number}", self.frustum_m
            camera = add_frustum(self._server, node, view.frustum, size, GREY, view.image)
            camera.on_click(lambda event, view=view: self._on_keyframe(view, event.client))
            self._cameras.append(camera)


def _extent(points_m: np.ndarray) -> float:
    """Size of a scene: twice the median distance of its points from their median, metres."""
    if not len(points_m):
        return 1.0
    away = np.linalg.norm(points_m - np.median(points_m, axis=0), axis=1)
    return max(2 * float(np.median(away)), 0.05)
