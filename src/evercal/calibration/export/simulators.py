"""The writers of simulators, which draw a pinhole without distortion.

Checked against the packages: images that MuJoCo draws, pybullet's matrices, USD's frustum,
Blender's projection and SAPIEN's matrices. A camera of SAPIEN looks along x with z up, the others
along -z with y up. All of them count pixels from the corner of the image, half a pixel before ours.
"""

import re
from collections.abc import Callable
from functools import partial

import numpy as np

from evercal.calibration.export.request import (
    Export,
    pose_numbers,
    standard_link_from_optical,
)
from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.typing import JsonObject

_NEAR_M = 0.01
_FAR_M = 100.0
_SENSOR_MM = 36.0
_LARGEST_OFFSET_PX = 0.5
_SQUARE = 1e-3
_MUJOCO = """<!-- {comment} Put it into the body of {parent}. -->
<camera name="{name}" pos="{} {} {}" quat="{} {} {} {}"
        resolution="{width} {height}" sensorsize="{sensor_x} {sensor_y}"
        focalpixel="{fx} {fy}" principalpixel="{left} {up}"/>
"""
_ISAAC = """#usda 1.0
(
    metersPerUnit = 1
    upAxis = "Z"
)

# {comment} Reference it below the prim of {parent}.
# Isaac Lab: OffsetCfg(pos, rot, convention="opengl") of the same matrix, transposed.
def Camera "{name}"
{{
    float2 clippingRange = ({near}, {far})
    float focalLength = {lens}
    float horizontalAperture = {sensor_x}
    float verticalAperture = {sensor_y}
    float horizontalApertureOffset = {offset_x}
    float verticalApertureOffset = {offset_y}
    matrix4d xformOp:transform = (
        ({}, {}, {}, {}),
        ({}, {}, {}, {}),
        ({}, {}, {}, {}),
        ({}, {}, {}, {})
    )
    uniform token[] xformOpOrder = ["xformOp:transform"]
}}
"""
_SAPIEN = """# {comment} x forward, y left, z up.
import sapien

{parent_}_from_camera = sapien.Pose([{}, {}, {}], [{}, {}, {}, {}])


def add_camera(scene, mount):
    camera = scene.add_mounted_camera(
        "{name}", mount, {parent_}_from_camera, {width}, {height}, 1.0, {near}, {far}
    )
    camera.set_perspective_parameters({near}, {far}, {fx}, {fy}, {edge_x}, {edge_y}, 0.0)
    return camera
"""
_PYBULLET = """# {comment} By column, for {parent} at the origin of the world.
# Elsewhere: view_matrix times the inverse of the pose of {parent}.
width = {width}
height = {height}
view_matrix = [
    {}, {}, {}, {},
    {}, {}, {}, {},
    {}, {}, {}, {},
    {}, {}, {}, {},
]
projection_matrix = [
    {sx}, 0.0, 0.0, 0.0,
    0.0, {sy}, 0.0, 0.0,
    {ox}, {oy}, {depth}, -1.0,
    0.0, 0.0, {depth_0}, 0.0,
]
# pybullet.getCameraImage(width, height, view_matrix, projection_matrix)
"""
_BLENDER = """# {comment} For {parent} at the origin of the world.
import bpy
from mathutils import Matrix

data = bpy.data.cameras.new("{name}")
data.sensor_fit = "HORIZONTAL"
data.sensor_width = {sensor_x}
data.lens = {lens}
data.shift_x = {shift_x}
data.shift_y = {shift_y}
camera = bpy.data.objects.new("{name}", data)
bpy.context.scene.collection.objects.link(camera)
camera.matrix_world = Matrix((
    ({}, {}, {}, {}),
    ({}, {}, {}, {}),
    ({}, {}, {}, {}),
    ({}, {}, {}, {}),
))
bpy.context.scene.camera = camera
render = bpy.context.scene.render
render.resolution_x = {width}
render.resolution_y = {height}
render.resolution_percentage = 100
render.pixel_aspect_x = {aspect_x}
render.pixel_aspect_y = {aspect_y}
"""


def _by_row(export: Export) -> list[float]:
    return export.numbers("matrix:opengl")


def _quaternion(export: Export) -> list[float]:
    return export.numbers("wxyz:opengl")


def _by_column(export: Export) -> list[float]:
    matrix = np.reshape(export.numbers("matrix:opengl"), (4, 4))
    return matrix.T.ravel().tolist()


def _view(export: Export) -> list[float]:
    """The inverse by column."""
    matrix = np.reshape(export.numbers("matrix:opengl"), (4, 4))
    return (np.linalg.inv(matrix).T.ravel() + 0.0).tolist()


def _link(export: Export) -> list[float]:
    """With x forward, y left, z up."""
    pose = export.pose @ standard_link_from_optical().inverse()
    return pose_numbers(pose, "wxyz").tolist()


def _write(
    template: str, numbers: Callable[[Export], list[float]], export: Export
) -> str:
    camera = export.camera
    if camera.model == "fisheye":
        raise InputError(
            "a simulator draws no fisheye; give a pinhole camera for undistorted images with `lens`"
        )
    optics = _optics(camera)
    if camera.distortion:
        export.notes.append(
            "the simulator draws images without distortion; undistort those of the camera before"
            " you compare them"
        )
    far = max(abs(optics["left"]), abs(optics["up"])) > _LARGEST_OFFSET_PX
    if template == _ISAAC and (far or abs(camera.fx / camera.fy - 1) > _SQUARE):
        export.notes.append(
            f"Isaac's renderer may take the mean of fx {camera.fx:.1f} and fy {camera.fy:.1f}, and"
            f" the middle of the image ({optics['left']:.1f}, {optics['up']:.1f} px away)"
        )
    names = {
        "name": re.sub(r"\W", "_", export.child),
        "parent": export.parent,
        "parent_": re.sub(r"\W", "_", export.parent),
        "comment": re.sub("-(?=-)", "- ", export.comment),
    }
    export.stated[:] = numbers(export)
    return template.format(*map(repr, export.stated), **names, **optics)


def _optics(camera: Camera) -> JsonObject:
    """What the templates state of a camera."""
    width = camera.width
    height = camera.height
    left = (width - 1) / 2 - camera.cx
    up = (height - 1) / 2 - camera.cy
    lens = camera.fx * _SENSOR_MM / width
    ratio = camera.fx / camera.fy
    return {
        **vars(camera),
        "left": left,
        "up": up,
        "lens": lens,
        "sensor_x": _SENSOR_MM,
        "sensor_y": lens * height / camera.fy,
        "offset_x": lens * left / camera.fx,
        "offset_y": -lens * up / camera.fy,
        "shift_x": left / width,
        "shift_y": -up * ratio / width,
        "aspect_x": max(1.0, 1 / ratio),
        "aspect_y": max(1.0, ratio),
        "edge_x": camera.cx + 0.5,
        "edge_y": camera.cy + 0.5,
        "sx": 2 * camera.fx / width,
        "sy": 2 * camera.fy / height,
        "ox": 2 * left / width,
        "oy": -2 * up / height,
        "near": _NEAR_M,
        "far": _FAR_M,
        "depth": -(_FAR_M + _NEAR_M) / (_FAR_M - _NEAR_M),
        "depth_0": -2 * _FAR_M * _NEAR_M / (_FAR_M - _NEAR_M),
    }


mujoco = partial(_write, _MUJOCO, _quaternion)
"""An MJCF camera; MuJoCo counts its principal point from there to the middle."""
isaac = partial(_write, _ISAAC, _by_column)
"""A USD camera; its matrix is for rows, and its offsets are to the right and up."""
sapien = partial(_write, _SAPIEN, _link)
"""The pose and the camera in Python, for ManiSkill as well."""
pybullet = partial(_write, _PYBULLET, _view)
"""The two matrices of getCameraImage, by column."""
blender = partial(_write, _BLENDER, _by_row)
"""A script that adds the camera and sets the size of images."""
