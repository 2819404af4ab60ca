"""The page: a server of viser with the map, calibrations, robot, recording and stream."""

import contextlib
import io
import socket
from dataclasses import dataclass
from pathlib import Path

import viser

from evercal.calibration.calibration import Calibration
from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.localization.localizer import Localizer
from evercal.localization.tracking import Tracker
from evercal.recordings import load_recording
from evercal.recordings.frame import Frame
from evercal.recordings.poses.camera_file import read_camera
from evercal.reports.scene.frusta import Ellipsoid, readable_scale
from evercal.service.viewer.calibrations import read_views
from evercal.service.viewer.drawn import DrawnCalibrations
from evercal.service.viewer.live import Live, open_source
from evercal.service.viewer.names import add_names
from evercal.service.viewer.panel import CalibrationPanel, KeyframePanel, MapPanel
from evercal.service.viewer.playback import Playback
from evercal.service.viewer.robot import Robot
from evercal.service.viewer.stage import Stage


@dataclass(frozen=True)
class ViewOptions:
    """What is shown beside the map, and where the page is."""

    calibrations: tuple[Path, ...] = ()
    """Calibration files."""
    live: str | None = None
    """Source that is tracked, as for `recordings.streams.stream`."""
    camera: Path | None = None
    """Intrinsics of the live camera; those of the scene if omitted."""
    urdf: Path | None = None
    """The arm."""
    recording: Path | None = None
    """Recording whose frames are located."""
    host: str = "127.0.0.1"
    """Address to listen on."""
    port: int = 8080
    """0 for any free port."""


class _Server(viser.ViserServer):
    """A server that is not shared over viser's public relay, whatever a visitor asks for."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


class Page:
    """A page that is being served; `close` ends it.

    Args:
        localizer: The map.
        options: What is shown.

    Raises:
        InputError: A file that cannot be read, a source that cannot be opened, or a port that
            cannot be used.
    """

    def __init__(self, localizer: Localizer, options: ViewOptions):
        scenes = localizer.contents.scenes
        views = read_views(options.calibrations, scenes[0].adjusted_camera)
        recording = None if options.recording is None else load_recording(options.recording)
        source = None if options.live is None else open_source(options.live)
        self.server = start_server(options.host, options.port)
        try:
            self._robot = None if options.urdf is None else Robot(self.server, options.urdf)
            self.stage = stage = Stage(self.server, scenes)
            scale = readable_scale([Ellipsoid.of(v.calibration.uncertain_pose) for v in views])
            self._calibrations = DrawnCalibrations(stage, views, scale)
            self._parts: list[Playback | Live] = []
            panel = MapPanel(stage, self._redraw)
            if source is not None and options.live is not None:
                frames, size = source
                camera = None if options.camera is None else read_camera(options.camera, size)
                tracker = Tracker(localizer, camera)
                self._parts.append(Live(stage, options.live, frames, tracker, panel.follow))
            if recording is not None:
                hand = gripper_from_camera([view.calibration for view in views])
                self._parts.append(
                    Playback(stage, recording, localizer, hand, panel.follow, self._move)
                )
            KeyframePanel(stage, panel)
            CalibrationPanel(stage, self._calibrations, scale, self._resize)
            self._resize(scale)
            self._calibrations.move(self._gripper(None))
        except BaseException:
            self.close()
            raise
        for part in self._parts:
            part.start()

    @property
    def url(self) -> str:
        """Address of the page."""
        return address_of(self.server)

    def close(self) -> None:
        """Stop threads and server."""
        for part in getattr(self, "_parts", ()):
            part.close()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def _resize(self, scale: float) -> None:
        self._calibrations.resize(scale)
        for part in self._parts:
            part.panel.resize(scale)

    def _redraw(self) -> None:
        self._calibrations.show()
        for part in self._parts:
            part.panel.redraw()

    def _move(self, frame: Frame) -> None:
        """Put arm and gripper where they were at a frame."""
        if self._robot is not None:
            self._robot.move(frame.joints_rad)
        self._calibrations.move(self._gripper(frame))

    def _gripper(self, frame: Frame | None) -> SE3 | None:
        """Pose of the gripper: stated by the frame, or that of the link that calibrations name."""
        if frame is not None and frame.base_from_gripper is not None:
            return frame.base_from_gripper
        names = {v.calibration.parent_frame for v in self._calibrations.views if v.on_gripper}
        links = [self._robot.base_from_link(name) for name in names] if self._robot else []
        return next((link for link in links if link is not None), None)


def gripper_from_camera(calibrations: list[Calibration]) -> SE3 | None:
    """The camera on the gripper, if exactly one calibration is of one."""
    hands = [c.parent_from_child for c in calibrations if c.mount == "eye_in_hand"]
    return hands[0] if len(hands) == 1 else None


def address_of(server: viser.ViserServer) -> str:
    """Address that a browser on this machine opens."""
    host = server.get_host()
    host = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, host)
    host = f"[{host}]" if ":" in host and not host.startswith("[") else host
    return f"http://{host}:{server.get_port()}"


def start_server(host: str, port: int, label: str = "evercal view") -> viser.ViserServer:
    """An empty page with z up.

    Raises:
        InputError: The address cannot be used; viser alone would take the next free port.
    """
    if not 0 <= port <= 65_535:
        raise InputError(f"--port {port}: give 0 to 65535")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM
        )[0]
        with socket.socket(family, kind, protocol) as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind(address)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"--host {host} --port {port}: {reason}; give another one") from None
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints a frame with its address
        server = _Server(host, port, label=label, verbose=False)
    if port and server.get_port() != port:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
        raise InputError(f"--host {host} --port {port}: Address already in use; give another one")
    server.gui.configure_theme(
        dark_mode=True,
        show_logo=False,
        show_share_button=False,
        control_width="large",
        brand_color=(37, 99, 235),
    )
    add_names(server, label)
    return server
