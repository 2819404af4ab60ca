"""The map in the scene of the page: landmarks, keyframes, base axes and grid."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import viser

from evercal.geometry import SE3
from evercal.mapping.scene_map import SceneMap
from evercal.reports.scene.frusta import Frustum
from evercal.reports.scene.map_parts import (
    ColourBy,
    KeyframeView,
    Landmarks3D,
    keyframe_views,
    shares,
)
from evercal.service.viewer.camera_set import CameraSet, linear

KEYFRAME_COLOUR = (120, 144, 180)
CHOSEN_COLOUR = (236, 72, 153)
_CELL_COLOUR, _SECTION_COLOUR = (44, 48, 56), (80, 87, 99)
_FRUSTUM = (0.02, 0.05)
"""Least and largest size of a frustum as a share of the extent of the map."""


class Stage:
    """Landmarks and keyframes of all scenes.

    Args:
        server: The page.
        scenes: Scenes of the map.
    """

    def __init__(self, server: viser.ViserServer, scenes: Sequence[SceneMap]):
        self.server = server
        most = shares([scene.landmarks for scene in scenes])
        self.landmarks = [Landmarks3D.of(scene, n) for scene, n in zip(scenes, most, strict=True)]
        self.keyframes = [keyframe_views(scene) for scene in scenes]
        self._names = [scene.name for scene in scenes]
        self.shown: str | None = self._names[0]
        self.extent_m = _extent(self.landmarks[0])
        self.frustum_m = _frustum_size(self.keyframes[0], self.extent_m)
        self._frames, self._clouds = [], []
        self._cameras: list[CameraSet] = []
        with server.atomic():
            self._add_base()
            for i in range(len(scenes)):
                self._add_scene(i)
        self._look_from_behind()

    @property
    def scenes(self) -> list[str]:
        """Names of the scenes."""
        return self._names

    def shows(self, scene: str | None) -> bool:
        """Whether what belongs to a scene is visible; None belongs to all."""
        return self.shown is None or scene is None or scene == self.shown

    def show(self, scene: str | None) -> None:
        """Show one scene, or all of them for None."""
        self.shown = scene
        with self.server.atomic():
            for name, frame in zip(self._names, self._frames, strict=True):
                frame.visible = self.shows(name)

    def colour_by(self, by: ColourBy) -> None:
        """Colour the landmarks."""
        for cloud, landmarks in zip(self._clouds, self.landmarks, strict=True):
            cloud.colors = landmarks.colours(by)

    def resize_points(self, size_mm: float) -> None:
        """Draw landmarks with a diameter in millimetres."""
        with self.server.atomic():
            for cloud in self._clouds:
                cloud.point_size = size_mm / 1000

    def show_keyframes(self, visible: bool) -> None:
        """Show or hide the keyframes."""
        with self.server.atomic():
            for cameras in self._cameras:
                cameras.visible = visible

    def mark(self, chosen: KeyframeView | None) -> None:
        """Colour the keyframe that was chosen last, or none."""
        with self.server.atomic():
            for views, cameras in zip(self.keyframes, self._cameras, strict=True):
                cameras.colour(
                    [CHOSEN_COLOUR if view is chosen else KEYFRAME_COLOUR for view in views]
                )

    def on_keyframe(self, chosen: Callable[[KeyframeView, viser.ClientHandle], Any]) -> None:
        """Call a function when a keyframe is clicked."""

        def clicked(event: viser.SceneClickEvent) -> None:
            view = self.keyframe_at(event.ray_origin, event.ray_direction)
            if view is not None:
                chosen(view, event.client)

        self.server.scene.on_click()(clicked)

    def keyframe_at(
        self, origin_m: Sequence[float], direction: Sequence[float]
    ) -> KeyframeView | None:
        """The first visible keyframe on a ray."""
        hits: list[tuple[float, int, int]] = []
        for i, cameras in enumerate(self._cameras):
            hit = cameras.hit(origin_m, direction) if self.shows(self._names[i]) else None
            if hit is not None:
                hits.append((hit[0], i, hit[1]))
        if not hits:
            return None
        _, scene, number = min(hits)
        return self.keyframes[scene][number]

    def _add_scene(self, i: int) -> None:
        """Add a scene; nodes are numbered, since names of scenes may hold a slash."""
        scene, landmarks = self.server.scene, self.landmarks[i]
        visible = self.shows(self._names[i])
        self._frames.append(scene.add_frame(f"/scenes/{i}", show_axes=False, visible=visible))
        self._clouds.append(
            scene.add_point_cloud(
                f"/scenes/{i}/landmarks",
                landmarks.points_m.astype(np.float32),
                landmarks.colours("image"),
                point_size=0.002 * self.extent_m,
                point_shape="circle",
                precision="float32",
                point_shading="flat",
            )
        )
        views = self.keyframes[i]
        cameras = CameraSet(
            self.server,
            f"/scenes/{i}/keyframes",
            [view.frustum for view in views],
            [view.image for view in views],
            self.frustum_m,
        )
        cameras.colour([KEYFRAME_COLOUR] * len(views))
        self._cameras.append(cameras)

    def _add_base(self) -> None:
        """Axes and floor of the robot base."""
        scene, length = self.server.scene, 0.12 * self.extent_m
        scene.add_frame("/base", axes_length=length, axes_radius=0.03 * length)
        scene.add_label("/base/label", "robot base", position=(0, 0, 0))
        cell = 0.1 if self.extent_m < 1.5 else 0.5
        add_floor(self.server, 2 * float(np.ceil(1.5 * self.extent_m)), cell)

    def _look_from_behind(self) -> None:
        """Begin above and behind the keyframes of the first scene, beside the panel."""
        poses = SE3.stack([view.frustum.base_from_camera for view in self.keyframes[0]])
        points = self.landmarks[0].points_m
        middle = poses.translation_m.mean(0)
        target = 0.6 * middle + 0.4 * (np.median(points, axis=0) if len(points) else middle)
        ahead = poses.rotation_matrix()[:, :, 2].mean(0) * (1, 1, 0)
        length = float(np.linalg.norm(ahead))
        ahead = ahead / length if length > 0.1 else np.array([0.0, 1.0, 0.0])
        right = np.array([ahead[1], -ahead[0], 0.0])
        eye = target + self.extent_m * (-0.8 * ahead + 0.25 * right + (0, 0, 0.5))
        target = target + 0.15 * self.extent_m * right  # the panel covers the right of the window
        camera = self.server.initial_camera
        camera.position = (float(eye[0]), float(eye[1]), float(eye[2]))
        camera.look_at = (float(target[0]), float(target[1]), float(target[2]))


def add_floor(server: viser.ViserServer, side_m: float, cell_m: float) -> None:
    """Lines at z = 0, stronger every metre.

    The grid of viser colours every pixel of the floor, which takes longer than all else without
    a GPU.
    """
    places = np.arange(-round(side_m / 2 / cell_m), round(side_m / 2 / cell_m) + 1) * cell_m
    ends = np.array([-side_m / 2, side_m / 2])
    lines = np.zeros((2, len(places), 2, 3), np.float32)
    lines[0, :, :, 0], lines[0, :, :, 1] = places[:, None], ends
    lines[1] = lines[0][..., [1, 0, 2]]
    whole = np.abs(places - np.round(places)) < 1e-6
    colours = linear(np.where(whole[:, None], _SECTION_COLOUR, _CELL_COLOUR))
    colours = np.broadcast_to(colours[None, :, None], lines.shape)
    server.scene.add_line_segments(
        "/grid",
        lines.reshape(-1, 2, 3),
        np.ascontiguousarray(colours).reshape(-1, 2, 3),
        thickness=1.0,
        thickness_units="screen",
    )


def add_frustum(
    server: viser.ViserServer,
    name: str,
    frustum: Frustum,
    size_m: float,
    colour: tuple[int, int, int],
    image: np.ndarray | None = None,
) -> viser.CameraFrustumHandle:
    """Add a camera to the scene, with its image."""
    return server.scene.add_camera_frustum(
        name,
        frustum.fov_rad,
        frustum.aspect,
        scale=size_m,
        thickness=2.0,
        thickness_units="screen",
        color=colour,
        image=image,
        jpeg_quality=75,
        wxyz=frustum.base_from_camera.rotation_wxyz,
        position=frustum.base_from_camera.translation_m,
        cast_shadow=False,
        receive_shadow=False,
    )


def _frustum_size(keyframes: Sequence[KeyframeView], extent_m: float) -> float:
    """Size at which neighbouring keyframes hardly overlap, within `_FRUSTUM`."""
    least, most = (share * extent_m for share in _FRUSTUM)
    places = np.array([view.frustum.base_from_camera.translation_m for view in keyframes])
    if len(places) < 2:
        return most
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1)
    np.fill_diagonal(apart, np.inf)
    return float(np.clip(0.6 * np.median(apart.min(1)), least, most))


def _extent(landmarks: Landmarks3D) -> float:
    """Size of a scene, metres: twice the median distance of its landmarks from their median."""
    if not len(landmarks):
        return 1.0
    away = landmarks.points_m - np.median(landmarks.points_m, axis=0)
    return max(2 * float(np.median(np.linalg.norm(away, axis=1))), 0.05)
