"""The page of `evercal view`: a map with calibrations, the arm and a tracked camera."""

import contextlib
import io
import secrets
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

import numpy as np
import viser

from evercal.calibration.calibration import Calibration, read_calibration
from evercal.errors import InputError
from evercal.geometry import SE3, norms
from evercal.live.camera import StreamCamera
from evercal.live.sources import open_camera
from evercal.localization.localizer import Localizer
from evercal.localization.tracking import Tracker
from evercal.recordings.cameras.camera_file import read_camera
from evercal.reports.answers import unit_known
from evercal.reports.overlay import resized
from evercal.reports.scene import THUMBNAIL_PX, ColourBy, Frustum, KeyframeView
from evercal.service.hosts import is_local, listening_socket, url_of
from evercal.service.viewer import drawing
from evercal.service.viewer.gate import chosen, gated
from evercal.service.viewer.html import (
    GREEN,
    calibration_rows,
    chip_html,
    position_mm,
    rows_html,
)
from evercal.service.viewer.overview import FOV_RAD, overview
from evercal.typing import ArrayPair, Size

_THROUGH = "/through"
"""Node of the image behind the landmarks of a keyframe."""
_PANEL_PX = 384
"""Width of the panel."""


class Page:
    """A page of a map that is being served; `close` ends it. Port 0 is any free one."""

    def __init__(
        self,
        localizer: Localizer,
        calibrations: Sequence[Path] = (),
        urdf: Path | None = None,
        address: tuple[str, int] = ("127.0.0.1", 0),
    ):
        self._localizer = localizer
        self._closed = threading.Event()
        given = {str(path): read_calibration(path) for path in calibrations}
        self.server = start_server(*address, "evercal view")
        try:
            scenes = localizer.contents.scenes
            server = self.server
            self.map = drawing.DrawnMap(server, scenes, self.look_through)
            gripper = drawing.add_base(server, 2.5 * self.map.extent_m)
            default = scenes[0].adjusted_camera
            size_m = self.map.frustum_m
            drawing.add_calibrations(server, given, self.map, default, size_m)
            if urdf:
                links = [c.parent_frame for c in given.values() if c.on_gripper]
                bases = [one.frames.base for one in (*scenes, *given.values())]
                drawing.add_arm(server, urdf, gripper, links, bases)
            self._outlines = [np.zeros((1, 3)), gripper.position[None]]
            for one in given.values():
                pose = one.parent_from_child
                if one.on_gripper:
                    pose = self.map.gripper_of(gripper, one) @ pose
                view = Frustum.of(pose, one.camera or default)
                self._outlines.append(view.corners(size_m))
            self._add_controls(given)
            # An initial camera could replace the view that fits a visitor's window.
            server.on_client_connect(self.look_from_above)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Stop tracking and the server."""
        self._closed.set()
        self.server.stop()

    def track(self, source: str, intrinsics: Path | None = None) -> None:
        """Show a camera, a video or a folder as it is tracked; by default with the map's camera."""
        camera = open_camera(source)
        height, width = camera.read()[1].shape[:2]
        size = (width, height)
        if not intrinsics:
            stated = camera.intrinsics()
        else:
            stated = read_camera(intrinsics, size)
        tracker = Tracker(self._localizer, stated)
        threading.Thread(
            target=self._track, args=(camera, tracker), daemon=True
        ).start()

    def look_through(self, view: KeyframeView, client: viser.ClientHandle) -> None:
        """Show a visitor what a keyframe shows: its image stands behind its landmarks."""
        pose = view.frustum.base_from_camera
        centre_m, width_m, height_m = backdrop(view)
        with client.atomic():
            client.scene.add_image(
                _THROUGH,
                view.image,
                width_m,
                height_m,
                wxyz=pose.rotation_wxyz,
                position=centre_m,
            )
            client.camera.position = pose.translation_m
            client.camera.wxyz = pose.rotation_wxyz
            client.camera.fov = view.frustum.fov_rad
        self.map.show_keyframes(False)  # they stand before the landmarks

    def look_from_above(self, client: viser.ClientHandle) -> None:
        """Show a visitor the overview."""
        camera = client.camera
        position, target = self._overview((camera.image_width, camera.image_height))
        with client.atomic():
            client.scene.remove_by_name(_THROUGH)
            camera.up_direction = (0.0, 0.0, 1.0)
            camera.fov = FOV_RAD
            camera.position = position
            camera.look_at = target
        self.map.show_keyframes(True)

    def _overview(self, size_px: Size) -> ArrayPair:
        """Landmarks, base, calibrations and gripper."""
        scene = chosen(self._scene)
        points = self.map.landmarks[scene].points_m
        apart = norms(points - np.median(points, axis=0))
        near = points[apart <= self.map.extent_m]  # nine of ten, or so
        points = np.concatenate([near, *self._outlines])
        keyframes = self.map.keyframes[scene]
        poses = SE3.stack([view.frustum.base_from_camera for view in keyframes])
        ahead = poses.rotation_matrix()[:, :, 2].mean(axis=0)
        return overview(points, ahead, size_px)

    def _add_controls(self, given: dict[str, Calibration]) -> None:
        gui = self.server.gui
        drawn = self.map
        keyframes = sum(map(len, drawn.keyframes.values()))
        landmarks = sum(map(len, drawn.landmarks.values()))
        with gui.add_folder("Map"):
            counts = [
                ("keyframes", f"{keyframes}, click one"),
                ("landmarks", f"{landmarks:,}"),
            ]
            gui.add_html(rows_html(counts))
            scene = self._scene = gui.add_dropdown("Scene", tuple(drawn.keyframes))
            scene.visible = len(drawn.keyframes) > 1
            colour = gui.add_dropdown("Colour", get_args(ColourBy))
            back = gui.add_button("Back to the overview")
        scene.on_update(lambda _: drawn.show(chosen(scene)))
        colour.on_update(lambda _: drawn.colour_by(chosen(colour)))
        back.on_click(lambda event: event.client and self.look_from_above(event.client))
        for name, calibration in given.items():
            with gui.add_folder(name):
                gui.add_html(rows_html(calibration_rows(calibration)))

    def _track(self, camera: StreamCamera, tracker: Tracker) -> None:
        """Show where a camera is, while the page is open somewhere."""
        server = self.server
        scenes = self._localizer.contents.scenes
        frustum = Frustum.of(
            SE3.identity(), tracker.camera or scenes[0].adjusted_camera
        )
        node = drawing.add_frustum(
            server, "/live", frustum, 1.3 * self.map.frustum_m, GREEN
        )
        drawing.place(node, None)
        with server.gui.add_folder("Live"):
            text = server.gui.add_html("")
        shown: str | None = None
        while not self._closed.is_set():
            if not server.get_clients():
                self._closed.wait(0.1)
                continue
            try:
                stamp_s, image = camera.read()
                tracked = tracker.track(image, stamp_s)
            except InputError as error:  # such as the end of a video
                text.content += chip_html("ended", str(error))
                break
            estimate = tracked.estimate
            rows = [("time", f"{estimate.milliseconds:.0f} ms")]
            pose = estimate.uncertain_pose
            if not pose or estimate.status != "ok":
                drawing.place(node, None)
            else:
                drawing.place(node, pose.pose)
                if estimate.scene != shown:  # else the visitor's choice stays
                    shown = str(estimate.scene)
                    self.map.show(shown)
                node.image = resized(image, THUMBNAIL_PX)
                rows.append(("scene", str(estimate.scene)))
                if unit_known(self._localizer, estimate.scene):
                    rows.append(("position", position_mm(pose.pose)))
                    rows.append(("1 sigma per axis", f"{pose.sigma_mm:.2g} mm"))
            chip = chip_html(tracked.state, estimate.reason)
            text.content = chip + rows_html(rows)
        camera.close()


def backdrop(view: KeyframeView) -> tuple[np.ndarray, float, float]:
    """Centre, width and height of a keyframe's image as a plane behind nearly all landmarks."""
    depth = 1.0
    if len(view.depths_m):
        depth = 1.05 * float(np.percentile(view.depths_m, 98))
    camera = view.camera
    x = ((camera.width - 1) / 2 - camera.cx) / camera.fx
    y = ((camera.height - 1) / 2 - camera.cy) / camera.fy
    centre = depth * np.array([x, y, 1.0])
    width = depth * camera.width / camera.fx
    height = depth * camera.height / camera.fy
    return view.frustum.base_from_camera.apply(centre), width, height


class _Server(viser.ViserServer):
    """A silent server that is not shared over viser's public relay, whatever a visitor asks."""

    key = ""
    """First part of the path; requests without it are refused."""

    @property
    def url(self) -> str:
        """Address that a browser on this machine opens, with the key."""
        return f"{url_of(self.get_host(), self.get_port())}/{self.key}/"

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None

    def stop(self) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            super().stop()


def start_server(host: str, port: int, label: str) -> _Server:
    """An empty page with z up; its address holds a random key."""
    listening_socket(host, port).close()  # viser alone would take the next free port
    key = secrets.token_urlsafe(16)
    # Viser prints.
    with gated(key, is_local(host)), contextlib.redirect_stdout(io.StringIO()):
        server = _Server(host, port, label=label, verbose=False)
    server.key = key
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    server.gui.main_panel.dock_right()
    server.gui.main_panel.set_width(_PANEL_PX)
    return server
