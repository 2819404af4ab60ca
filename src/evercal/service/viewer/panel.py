"""Controls of the map beside the scene: scenes, colours, keyframes, calibrations."""

from collections.abc import Callable
from typing import Any

import viser

from evercal.reports.scene.map_parts import ColourBy, KeyframeView
from evercal.service.viewer.drawn import CALIBRATION_COLOUR, DrawnCalibrations
from evercal.service.viewer.stage import Stage
from evercal.service.viewer.text import block, chip, note_html, picture_html, rows_html

ALL = "all scenes"
COLOURINGS: tuple[ColourBy, ...] = ("image", "height", "uncertainty")
_THROUGH = "/through"
_HINT = "Click a keyframe to look through it."


class MapPanel:
    """The folder "Map".

    Args:
        stage: The scene.
        on_scene: Called when other scenes are shown.
    """

    def __init__(self, stage: Stage, on_scene: Callable[[], Any]):
        self._stage, self._on_scene, gui = stage, on_scene, stage.server.gui
        landmarks = sum(map(len, stage.landmarks))
        total = sum(len(view.pixels) for views in stage.keyframes for view in views)
        count = f"{landmarks:,}" if landmarks == total else f"{landmarks:,} of {total:,}"
        keyframes = sum(map(len, stage.keyframes))
        with gui.add_folder("Map"):
            gui.add_html(rows_html([("keyframes", f"{keyframes}"), ("landmarks", count)]))
            options = [*stage.scenes, *([ALL] if len(stage.scenes) > 1 else [])]
            self._scene = gui.add_dropdown("Scene", options)
            colour = gui.add_dropdown("Colour", COLOURINGS)
            self._size = gui.add_slider(
                "Points, mm", 0.5, 20.0, 0.5, min(20.0, max(0.5, round(2 * 6 * stage.extent_m) / 2))
            )
            self._keyframes = gui.add_checkbox("Keyframes", True)
        self._scene.on_update(lambda _: self._changed())
        colour.on_update(lambda _: stage.colour_by(colour.value))
        for handle in (self._size, self._keyframes):
            handle.on_update(lambda _: self.inspect(False))
        self.inspect(False)

    def inspect(self, through: bool) -> None:
        """Draw points and keyframes as chosen; to look through a keyframe, small points alone."""
        size = self._size.value
        self._stage.resize_points(min(size, 3.0) if through else size)
        self._stage.show_keyframes(self._keyframes.value and not through)

    def follow(self, scene: str | None) -> None:
        """Show the scene of an answer."""
        if not self._stage.shows(scene) and scene in self._stage.scenes:
            self._scene.value = scene

    def _changed(self) -> None:
        self._stage.show(None if self._scene.value == ALL else self._scene.value)
        self._on_scene()


class KeyframePanel:
    """The folder "Keyframe": the image of the one that was clicked, and the way through it.

    Args:
        stage: The scene.
        map_panel: How points and keyframes are drawn.
    """

    def __init__(self, stage: Stage, map_panel: MapPanel):
        self._stage, self._map, gui = stage, map_panel, stage.server.gui
        self._before: dict[int, tuple[Any, ...]] = {}
        with gui.add_folder("Keyframe"):
            self._text = gui.add_html(note_html(_HINT))
            self._image = gui.add_html("", visible=False)
            self._back = gui.add_button("Back to the overview", visible=False)
        stage.on_keyframe(self.look_through)
        self._back.on_click(lambda _: self._return())
        stage.server.on_client_disconnect(self._forget)

    def look_through(self, view: KeyframeView, client: viser.ClientHandle) -> None:
        """Look through a keyframe: its image stands behind its landmarks."""
        camera, stage, frustum = client.camera, self._stage, view.frustum
        state = camera.position, camera.look_at, camera.up_direction, camera.fov
        self._before.setdefault(client.client_id, state)
        backdrop, pose = view.backdrop, frustum.base_from_camera
        with client.atomic():
            client.scene.add_image(
                _THROUGH,
                view.image,
                backdrop.width_m,
                backdrop.height_m,
                wxyz=pose.rotation_wxyz,
                position=backdrop.centre_m,
                jpeg_quality=90,
                cast_shadow=False,
                receive_shadow=False,
            )
            camera.position = pose.translation_m
            camera.wxyz = pose.rotation_wxyz
            camera.fov = frustum.fov_rad
        self._map.inspect(True)
        stage.mark(view)
        rows = [
            ("keyframe", f"{view.number} of {view.scene}"),
            ("landmarks", str(len(view.pixels))),
        ]
        self._text.content = rows_html(rows)
        words = f"keyframe {view.number} with its landmarks, coloured by depth"
        self._image.content = picture_html(view.picture, words)
        self._image.visible = self._back.visible = True

    def _forget(self, client: viser.ClientHandle) -> None:
        self._before.pop(client.client_id, None)

    def _return(self) -> None:
        """Let every visitor look from where they looked before, as all share the panel."""
        clients = self._stage.server.get_clients()
        while self._before:
            number, before = self._before.popitem()
            if number not in clients:
                continue
            client, camera = clients[number], clients[number].camera
            with client.atomic():
                client.scene.remove_by_name(_THROUGH)
                camera.position, camera.look_at, camera.up_direction, camera.fov = before
        self._map.inspect(False)
        self._stage.mark(None)
        self._image.visible = self._back.visible = False
        self._text.content = note_html(_HINT)


class CalibrationPanel:
    """The folder "Calibrations": their numbers, and the scale of the ellipsoids.

    Args:
        stage: The scene.
        drawn: The calibrations in it.
        scale: Initial factor of the ellipsoids.
        on_scale: Called with a new factor.
    """

    def __init__(
        self, stage: Stage, drawn: DrawnCalibrations, scale: float, on_scale: Callable[[float], Any]
    ):
        gui = stage.server.gui
        with gui.add_folder("Calibrations"):
            if not drawn.views:
                gui.add_html(note_html("None was given."))
            for view in drawn.views:
                gui.add_html(block(chip(view.name, CALIBRATION_COLOUR)) + rows_html(view.rows()))
            slider = gui.add_slider("Ellipsoids x", 1, 500, 1, round(scale))
        slider.on_update(lambda _: on_scale(slider.value))
