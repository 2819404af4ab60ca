"""The page of `evercal view`: a map with calibrations, the arm and a tracked camera."""

from collections.abc import Sequence
from pathlib import Path
from typing import get_args

import viser

from evercal.calibration.calibration import Calibration, read_calibration
from evercal.live.camera import StreamCamera
from evercal.localization.localizer import Localizer
from evercal.localization.tracking import Tracker
from evercal.recordings.poses.camera_file import read_camera
from evercal.reports.scene.map_parts import ColourBy, KeyframeView
from evercal.service.viewer.calibrations import DrawnCalibrations, calibration_rows
from evercal.service.viewer.drawing import DrawnMap, add_base
from evercal.service.viewer.html import rows_html
from evercal.service.viewer.live import Live
from evercal.service.viewer.robot import Robot
from evercal.service.viewer.server import address_of, start_server

ALL = "all scenes"
_THROUGH = "/through"


class Page:
    """A page that is being served; `close` ends it.

    Args:
        localizer: The map.
        calibrations: Files of calibrations.
        urdf: The arm.
        address: Host and port; 0 for any free port.

    Raises:
        InputError: A file that cannot be read, or a port that cannot be used.
    """

    def __init__(
        self,
        localizer: Localizer,
        calibrations: Sequence[Path] = (),
        urdf: Path | None = None,
        address: tuple[str, int] = ("127.0.0.1", 0),
    ):
        self._localizer, scenes = localizer, localizer.contents.scenes
        self._given = _read_calibrations(calibrations)
        self.server = start_server(*address, "evercal view")
        self._robot: Robot | None = None
        self._live: Live | None = None
        try:
            self.map = DrawnMap(self.server, scenes, self.look_through)
            self.map.look_from_behind()
            add_base(self.server, 2.5 * self.map.extent_m)
            default, size_m = scenes[0].adjusted_camera, self.map.frustum_m
            self._calibrations = DrawnCalibrations(self.server, self._given, default, size_m)
            self._add_controls()
            self._robot = None if urdf is None else Robot(self.server, urdf, self._draw)
            self._draw()
        except BaseException:
            self.close()
            raise

    @property
    def url(self) -> str:
        """Address of the page."""
        return address_of(self.server)

    def track(self, source: str, intrinsics: Path | None = None) -> None:
        """Show a camera, a video or a folder as it is tracked; by default with the map's camera."""
        camera = StreamCamera(source)
        height, width = camera.read()[1].shape[:2]
        given = None if intrinsics is None else read_camera(intrinsics, (width, height))
        size_m = 1.3 * self.map.frustum_m
        tracker = Tracker(self._localizer, given)
        self._live = Live(self.server, camera, tracker, size_m, self._follow)

    def close(self) -> None:
        """Stop the stream and the server."""
        if self._live is not None:
            self._live.close()
        self.server.stop()

    def look_through(self, view: KeyframeView, client: viser.ClientHandle) -> None:
        """Show a visitor what a keyframe shows: its image stands behind its landmarks."""
        backdrop, pose = view.backdrop, view.frustum.base_from_camera
        with client.atomic():
            client.scene.add_image(
                _THROUGH,
                view.image,
                backdrop.width_m,
                backdrop.height_m,
                wxyz=pose.rotation_wxyz,
                position=backdrop.centre_m,
            )
            client.camera.position, client.camera.wxyz = pose.translation_m, pose.rotation_wxyz
            client.camera.fov = view.frustum.fov_rad
        self._keyframes.value = False

    def look_from_above(self, client: viser.ClientHandle) -> None:
        """Bring a visitor back to the first view."""
        first = self.server.initial_camera
        with client.atomic():
            client.scene.remove_by_name(_THROUGH)
            client.camera.up_direction, client.camera.fov = (0.0, 0.0, 1.0), first.fov
            client.camera.position, client.camera.look_at = first.position, first.look_at
        self._keyframes.value = True

    def _add_controls(self) -> None:
        gui, drawn = self.server.gui, self.map
        keyframes, landmarks = sum(map(len, drawn.keyframes)), sum(map(len, drawn.landmarks))
        with gui.add_folder("Map"):
            counts = [("keyframes", f"{keyframes}"), ("landmarks", f"{landmarks:,}")]
            gui.add_html(rows_html(counts))
            self._scene = gui.add_dropdown("Scene", [*drawn.names, ALL])
            colour = gui.add_dropdown("Colour", get_args(ColourBy))
            points = gui.add_slider("Points, mm", 1, 30, 1, min(1 + int(3 * drawn.extent_m), 30))
            self._keyframes = gui.add_checkbox("Keyframes", True, hint="click one to look through")
            back = gui.add_button("Back to the overview")
        self._scene.on_update(lambda _: self._draw())
        colour.on_update(lambda _: drawn.colour_by(colour.value))
        points.on_update(lambda _: drawn.resize_points(points.value))
        self._keyframes.on_update(lambda _: drawn.show_keyframes(self._keyframes.value))
        back.on_click(lambda event: event.client and self.look_from_above(event.client))
        for name, calibration in self._given.items():
            with gui.add_folder(name):
                gui.add_html(rows_html(calibration_rows(calibration)))

    def _follow(self, scene: str) -> None:
        """Show the scene of an answer."""
        if self._scene.value not in (scene, ALL):
            self._scene.value = scene

    def _draw(self) -> None:
        """Show the scene that is chosen, and cameras on the gripper where its link is."""
        scene = None if self._scene.value == ALL else self._scene.value
        self.map.show(scene)
        hands = [found for found in self._given.values() if found.mount == "eye_in_hand"]
        links = [self._robot.base_from_link(c.parent_frame) for c in hands] if self._robot else []
        self._calibrations.show(scene, next((link for link in links if link is not None), None))


def _read_calibrations(paths: Sequence[Path]) -> dict[str, Calibration]:
    """Calibrations by name; two files of one name from two folders stay apart."""
    calibrations: dict[str, Calibration] = {}
    for path in paths:
        name = str(path) if path.stem in calibrations else path.stem
        calibrations[name] = read_calibration(path)
    return calibrations
