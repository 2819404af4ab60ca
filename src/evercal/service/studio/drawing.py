"""The studio in 3D: arm, live camera, samples, the next view, map and calibrations."""

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from evercal.geometry import SE3
from evercal.reports.scene.frusta import Ellipsoid, Frustum, readable_scale
from evercal.reports.scene.map_parts import THUMBNAIL_PX, resized
from evercal.service.studio.book import Proposal
from evercal.service.studio.devices import Image, Seen
from evercal.service.studio.studio import Studio
from evercal.service.viewer.answers import AMBER, BLUE, GREEN, RED
from evercal.service.viewer.calibrations import CalibrationView
from evercal.service.viewer.camera_set import CameraSet, linear
from evercal.service.viewer.drawn import DrawnCalibrations, place_frustum
from evercal.service.viewer.stage import Stage, add_floor, add_frustum

_SIZE_M = 0.045
"""Length of a drawn camera."""
_POINT_MM = 3.0
_ARM = (203, 213, 225)


class Drawing:
    """The scene of the page.

    Args:
        server: the page.
        studio: what is drawn.
        on_sample: called with the name of a sample that is clicked.
    """

    def __init__(self, server: viser.ViserServer, studio: Studio, on_sample: Callable[[str], Any]):
        self._server, self._studio, self._on_sample = server, studio, on_sample
        # The live image, tasks and clicks come in threads of their own, and nodes are replaced.
        self._lock = threading.RLock()
        self._samples: CameraSet | None = None
        self._names: tuple[str, ...] = ()
        self._thumbnails: dict[str, Image] = {}
        self._calibrations: DrawnCalibrations | None = None
        self._drawn: tuple[object, ...] = ()
        self._arm: viser.LineSegmentsHandle | None = None
        nowhere = Frustum.of(SE3.identity(), studio.devices.intrinsics)
        self._live = add_frustum(server, "/live", nowhere, 1.3 * _SIZE_M, BLUE)
        self._ghost = add_frustum(server, "/next", nowhere, 1.3 * _SIZE_M, AMBER)
        self._label = server.scene.add_label("/next_label", "next view", anchor="bottom-center")
        for node in (self._live, self._ghost, self._label):
            node.visible = False
        server.scene.on_click()(self._clicked)
        self._add_floor()

    def show_live(self, seen: Seen, picture: Image | None) -> None:
        """Draw arm and camera where they are."""
        pose, mount = seen.base_from_gripper, self._studio.gripper_from_camera
        if pose is None:
            return
        camera = pose @ (mount or SE3.identity())
        with self._server.atomic(), self._lock:
            frustum = Frustum.of(camera, self._studio.devices.intrinsics)
            place_frustum(self._live, frustum)
            if picture is not None:
                self._live.image = resized(picture, THUMBNAIL_PX)
            self._live.visible = True
            if self._studio.devices.arm is not None:
                self._draw_arm(np.asarray(self._studio.devices.arm(), np.float32))
            if self._calibrations is not None:
                self._calibrations.move(pose)

    def show_proposal(self, proposal: Proposal | None) -> None:
        """Draw the next view as a ghost."""
        with self._server.atomic(), self._lock:
            self._ghost.visible = self._label.visible = proposal is not None
            if proposal is None:
                return
            frustum = Frustum.of(proposal.base_from_camera, self._studio.devices.intrinsics)
            place_frustum(self._ghost, frustum)
            x, y = proposal.base_from_camera.translation_m[:2]
            self._label.position = (x, y, float(frustum.corners(_SIZE_M)[:, 2].max()))
            self._label.text = "next view"

    def show_samples(self, bad: set[str]) -> None:
        """Draw the samples, the bad ones in red."""
        mount = self._studio.gripper_from_camera or SE3.identity()
        frusta: dict[str, Frustum] = {}
        for frame in self._studio.book.frames:
            if frame.base_from_gripper is not None:
                place = Frustum.of(frame.base_from_gripper @ mount, frame.camera)
                frusta[frame.name] = place
                if frame.name not in self._thumbnails:
                    self._thumbnails[frame.name] = resized(frame.read_image(), THUMBNAIL_PX)
        with self._server.atomic(), self._lock:
            if self._samples is not None:
                self._samples.remove()
                self._samples = None
            self._names = tuple(frusta)
            if frusta:
                images = [self._thumbnails[name] for name in frusta]
                self._samples = CameraSet(
                    self._server, "/samples", list(frusta.values()), images, _SIZE_M
                )
                self._samples.colour([RED if name in bad else GREEN for name in frusta])

    def show_results(self) -> None:
        """Draw the map and the calibrations, if they have changed."""
        cell, found = self._studio.cell, self._studio.calibrations
        drawn = (cell.scenes, self._studio.learned, *found.values())
        if not cell.scenes or drawn == self._drawn:
            return
        self._drawn, scenes = drawn, cell.localizer.contents.scenes
        with self._server.atomic(), self._lock:
            for name in ("/scenes", "/calibrations"):
                self._server.scene.remove_by_name(name)
            stage = Stage(self._server, scenes)
            stage.resize_points(_POINT_MM)
            stage.show_keyframes(False)
            stage.show(self._studio.scene if self._studio.scene in cell.scenes else None)
            self._look()
            default = scenes[0].adjusted_camera
            views = [
                CalibrationView(name, calibration, calibration.camera or default)
                for name, calibration in found.items()
            ]
            ellipsoids = [Ellipsoid.of(view.calibration.uncertain_pose) for view in views]
            drawn_views = DrawnCalibrations(stage, views, readable_scale(ellipsoids))
            drawn_views.move(self._studio.connection.seen.base_from_gripper)
            self._calibrations = drawn_views

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        """Choose the sample that was clicked."""
        with self._lock:
            hit = self._samples and self._samples.hit(event.ray_origin, event.ray_direction)
            name = self._names[hit[1]] if hit else None
        if name is not None:
            self._on_sample(name)

    def _draw_arm(self, points: np.ndarray) -> None:
        """Draw the arm as a line through its joints."""
        points = np.concatenate([np.zeros((1, 3), np.float32), points])  # from the base
        pairs = np.stack([points[:-1], points[1:]], axis=1)
        if self._arm is None:
            colours = np.broadcast_to(linear(np.array(_ARM)), pairs.shape)
            self._arm = self._server.scene.add_line_segments(
                "/arm", pairs, colours, thickness=8.0, thickness_units="screen"
            )
        self._arm.points = pairs

    def _add_floor(self) -> None:
        scene = self._server.scene
        scene.add_frame("/base", axes_length=0.15, axes_radius=0.005)
        scene.add_label("/base/label", "robot base", position=(0, 0, 0))
        add_floor(self._server, 3.0, 0.1)
        self._look()

    def _look(self) -> None:
        """Begin beside the arm, above the work area."""
        camera = self._server.initial_camera
        camera.position, camera.look_at = (1.15, -0.8, 0.85), (0.35, 0.0, 0.3)
