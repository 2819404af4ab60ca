"""Cameras, maps, calibrations and the arm in the scene of a page."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import viser

from evercal.calibration.calibration import Calibration
from evercal.errors import InputError, optional_module
from evercal.geometry import SE3, Camera, norms
from evercal.mapping.scene_map import SceneMap
from evercal.reports.overlay import resized
from evercal.reports.scene import (
    THUMBNAIL_PX,
    ColourBy,
    Ellipsoid,
    Frustum,
    KeyframeView,
    Landmarks3D,
    keyframe_views,
    readable_scale,
    surface,
)
from evercal.robot.robot_model import RobotModel
from evercal.service.viewer.html import BLUE, MAGENTA, PALE, Colour

OnKeyframe = Callable[[KeyframeView, viser.ClientHandle], Any]
GRIPPER = "/gripper"
"""Node of what moves with the gripper."""
_PIXEL = 0.0008
"""Size of a pixel of a surface, metres per millimetre from the next one."""


def add_frustum(
    server: viser.ViserServer,
    name: str,
    frustum: Frustum,
    size_m: float,
    colour: Colour,
    image: np.ndarray | None = None,
) -> viser.CameraFrustumHandle:
    """Add a camera with its image to the scene."""
    if image is not None:
        image = resized(image, THUMBNAIL_PX)
    return server.scene.add_camera_frustum(
        name,
        frustum.fov_rad,
        frustum.aspect,
        scale=size_m,
        thickness=2.0,
        thickness_units="screen",
        color=colour,
        image=image,
        wxyz=frustum.base_from_camera.rotation_wxyz,
        position=frustum.base_from_camera.translation_m,
    )


def place(node: viser.SceneNodeHandle, base_from_node: SE3 | None) -> None:
    """Move a node of the scene; None hides it."""
    node.visible = base_from_node is not None
    if base_from_node:
        node.wxyz = base_from_node.rotation_wxyz
        node.position = base_from_node.translation_m


def add_base(server: viser.ViserServer, side_m: float) -> viser.FrameHandle:
    """Add the axes of the robot base and a floor; returns the hidden node of the gripper."""
    server.scene.add_frame(
        "/base", axes_length=0.05 * side_m, axes_radius=0.0015 * side_m
    )
    server.scene.add_label("/base/label", "robot base")
    server.scene.add_grid(
        "/floor",
        side_m,
        side_m,
        cell_size=0.1,
        cell_color=PALE,
        section_color=PALE,
        cell_thickness=0.5,
        shadow_opacity=0.0,
    )
    return server.scene.add_frame(GRIPPER, show_axes=False, visible=False)


class DrawnMap:
    """Landmarks and keyframes of all scenes; a map that was drawn before is replaced."""

    def __init__(
        self,
        server: viser.ViserServer,
        scenes: Sequence[SceneMap],
        on_keyframe: OnKeyframe | None = None,
    ):
        self.landmarks = {scene.name: Landmarks3D.of(scene) for scene in scenes}
        self.keyframes = {scene.name: keyframe_views(scene) for scene in scenes}
        # Twice the median distance of landmarks from their median.
        points = self.landmarks[scenes[0].name].points_m
        distances = norms(points - np.median(points, axis=0))
        self.extent_m = max(2 * float(np.median(distances)), 0.05)
        self.frustum_m = 0.03 * self.extent_m
        self._nodes: dict[str, viser.FrameHandle] = {}
        self._clouds: dict[str, viser.PointCloudHandle] = {}
        self._surfaces: list[viser.PointCloudHandle] = []
        self._cameras: list[viser.CameraFrustumHandle] = []
        server.scene.remove_by_name("/map")
        with server.atomic():
            for scene in scenes:
                self._add(server, scene.name, on_keyframe)
                self._add_surface(server, scene)
            self.colour_by("image")
        self.show(scenes[0].name)

    def node(self, scene: object) -> str:
        """Node of a scene; that of the base for what belongs to none."""
        node = self._nodes.get(str(scene))
        if node is None:
            return "/base"
        return node.name

    def gripper_of(self, node: viser.FrameHandle, calibration: Calibration) -> SE3:
        """Pose of the gripper; without an arm, as it was at the first keyframe of its scene."""
        keyframes = self.keyframes.get(str(calibration.source.get("scene")))
        if keyframes and not node.visible:
            pose = keyframes[0].frustum.base_from_camera
            place(node, pose @ calibration.parent_from_child.inverse())
        return SE3(node.wxyz, node.position)

    def show(self, scene: str) -> None:
        """Show one scene; visitors show others in the scene tree of viser's settings."""
        for name, node in self._nodes.items():
            node.visible = name == scene

    def show_keyframes(self, visible: bool) -> None:
        """Show or hide the keyframes."""
        for camera in self._cameras:
            camera.visible = visible

    def colour_by(self, by: ColourBy) -> None:
        """Show the surface as in the images, or landmarks in the colour of a value."""
        for name, cloud in self._clouds.items():
            cloud.colors = self.landmarks[name].colours(by)
            cloud.visible = by != "image"
        for cloud in self._surfaces:
            cloud.visible = by == "image"

    def _add_surface(self, server: viser.ViserServer, scene: SceneMap) -> None:
        """Pixels of one size are one node."""
        pixels = surface(scene)
        powers = np.round(np.log2(pixels.sigma_mm))
        for power in np.unique(powers).tolist():
            chosen = powers == power
            cloud = server.scene.add_point_cloud(
                f"{self.node(scene.name)}/surface {power:g}",
                pixels.points_m[chosen].astype(np.float32),
                pixels.colours("image")[chosen],
                point_size=_PIXEL * 2.0**power,
                precision="float32",
                point_shading="flat",
            )
            self._surfaces.append(cloud)

    def _add(
        self, server: viser.ViserServer, name: str, on_keyframe: OnKeyframe | None
    ) -> None:
        node = f"/map/{name.replace('/', '_')}"
        self._nodes[name] = server.scene.add_frame(node, show_axes=False)
        self._clouds[name] = server.scene.add_point_cloud(
            f"{node}/landmarks",
            self.landmarks[name].points_m.astype(np.float32),
            (0, 0, 0),
            point_size=0.005 * self.extent_m,
            point_shape="circle",
            precision="float32",
        )
        if on_keyframe is None:
            return
        for view in self.keyframes[name]:
            keyframe = f"{node}/keyframes/{view.number}"
            camera = add_frustum(
                server, keyframe, view.frustum, self.frustum_m, BLUE, view.image
            )
            camera.on_click(lambda event, view=view: on_keyframe(view, event.client))
            self._cameras.append(camera)


def add_calibrations(
    server: viser.ViserServer,
    calibrations: dict[str, Calibration],
    drawn: DrawnMap | None,
    default: Camera,
    size_m: float,
) -> None:
    """Add cameras in their scenes or on the gripper, with ellipsoids of their positions.

    Where no map is drawn, they are in the base.
    """
    ellipsoids = [Ellipsoid.of(c.uncertain_pose) for c in calibrations.values()]
    scale = readable_scale(ellipsoids, size_m / 2)
    for ellipsoid, (name, calibration) in zip(
        ellipsoids, calibrations.items(), strict=True
    ):
        parent = "/base"
        if calibration.on_gripper:
            parent = GRIPPER
        elif drawn:
            parent = drawn.node(calibration.source.get("scene"))
        node = f"{parent}/{name.replace('/', '_')}"
        camera = calibration.camera or default
        frustum = Frustum.of(calibration.parent_from_child, camera)
        add_frustum(server, node, frustum, size_m, MAGENTA)
        x, y, z = np.maximum(scale * np.asarray(ellipsoid.axes_m), 1e-6).tolist()
        server.scene.add_icosphere(
            f"{node} ellipsoid",
            scale=(x, y, z),
            color=MAGENTA,
            opacity=0.35,
            wxyz=ellipsoid.rotation_wxyz,
            position=ellipsoid.centre_m,
        )
        sigma = f"{calibration.sigma_mm:.2g} mm (1 sigma)"
        words = f"{Path(name).stem}: {sigma}, ellipsoid x {scale:g}"
        server.scene.add_label(f"{node}/label", words)


def add_arm(
    server: viser.ViserServer,
    path: Path,
    gripper: viser.FrameHandle,
    links: Sequence[str],
    bases: Sequence[str] = (),
) -> list[viser.GuiSliderHandle[float]]:
    """Add an arm at the robot base, and a slider for each joint, which are returned.

    The node `gripper` moves with the first of `links` that the arm has. The base is the first of
    `bases` that it has, else its root.
    """
    model = RobotModel(path)  # reports what is wrong in the file
    optional_module("yourdfpy", "drawing an arm needs yourdfpy", "urdf")
    from viser.extras import ViserUrdf

    link = next((link for link in links if link in model.links), None)
    root = model.base_link
    base = next((link for link in bases if link in model.links), root)
    robot = server.scene.add_frame("/robot", show_axes=False)
    try:
        shown = ViserUrdf(server, path, root_node_name="/robot")
    except Exception as error:  # trimesh raises many types for broken meshes
        text = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise InputError(
            f"{path}: cannot be drawn ({text}); check its meshes"
        ) from None
    limits = shown.get_actuated_joint_limits()
    sliders = []

    def move() -> None:
        values = np.array([slider.value for slider in sliders])
        shown.update_cfg(values)
        pose_of = partial(model.poses, tuple(limits), values[None], base)
        place(robot, pose_of(root).poses[0])
        if link is not None:
            place(gripper, pose_of(link).poses[0])

    with server.gui.add_folder("Arm", expand_by_default=False):
        for name, (low, high) in limits.items():
            if low is None:
                low = -np.pi
            if high is None:
                high = np.pi
            start = min(max(0.0, low), high)
            slider = server.gui.add_slider(name, low, high, 0.01, start)
            slider.on_update(lambda _: move())
            sliders.append(slider)
    move()
    return sliders
