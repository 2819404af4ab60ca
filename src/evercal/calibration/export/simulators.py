"""The writers of simulators, which draw a pinhole without distortion.

Checked against the packages: images that MuJoCo draws, pybullet's matrices, USD's frustum,
Blender's projection and SAPIEN's matrices. A camera of SAPIEN looks along x with z up, the others
along -z with y up. All of them count pixels from the corner of the image, half a pixel before ours.
"""

import re
from collections.abc import Callable
from functools import partial
from operator import methodcaller

from evercal.calibration.export.request import (
    Export,
    pose_numbers,
    standard_link_from_optical,
)
from evercal.errors import InputError
from evercal.recordings.poses.conventions import OPENGL_FROM_OPENCV

_LARGEST_OFFSET_PX = 0.5
_SQUARE = 1e-3
_MUJOCO = """<!-- {comment} Put it into the body of {parent}. -->
<camera name="{name}" pos="{} {} {}" quat="{} {} {} {}"
        resolution="{width} {height}" sensorsize="{width}e-5 {height}e-5"
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
    float2 clippingRange = (0.01, 100)
    float focalLength = {fx}
    float horizontalAperture = {width}
    float verticalAperture = {aperture_y}
    float horizontalApertureOffset = {left}
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
        "{name}", mount, {parent_}_from_camera, {width}, {height}, 1.0, 0.01, 100.0
    )
    camera.set_perspective_parameters(
        0.01, 100.0, {fx}, {fy}, {cx} + 0.5, {cy} + 0.5, 0.0
    )
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
near = 0.01
far = 100.0
projection_matrix = [
    2 * {fx} / width, 0.0, 0.0, 0.0,
    0.0, 2 * {fy} / height, 0.0, 0.0,
    2 * {left} / width, -2 * {up} / height, (far + near) / (near - far), -1.0,
    0.0, 0.0, 2 * far * near / (near - far), 0.0,
]
# pybullet.getCameraImage(width, height, view_matrix, projection_matrix)
"""
_BLENDER = """# {comment} For {parent} at the origin of the world.
import bpy
from mathutils import Matrix

data = bpy.data.cameras.new("{name}")
data.sensor_fit = "HORIZONTAL"
data.sensor_width = 36.0
data.lens = 36.0 * {fx} / {width}
data.shift_x = {left} / {width}
data.shift_y = {offset_y} / {width}
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
render.pixel_aspect_x = max(1.0, {fy} / {fx})
render.pixel_aspect_y = max(1.0, {fx} / {fy})
"""


def _by_column(export: Export, inverse: bool = False) -> list[float]:
    matrix = export.pose @ OPENGL_FROM_OPENCV
    if inverse:
        matrix = matrix.inverse()
    return (matrix.matrix().T.ravel() + 0.0).tolist()


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
    left = (camera.width - 1) / 2 - camera.cx
    up = (camera.height - 1) / 2 - camera.cy
    ratio = camera.fx / camera.fy
    if camera.distortion:
        export.notes.append(
            "the simulator draws images without distortion; undistort those of the camera before"
            " you compare them"
        )
    apart = max(abs(left), abs(up)) > _LARGEST_OFFSET_PX or abs(ratio - 1) > _SQUARE
    if apart and template == _ISAAC:
        export.notes.append(
            f"Isaac's renderer may take the mean of fx {camera.fx:.1f} and fy {camera.fy:.1f}, and"
            f" the middle of the image ({left:.1f}, {up:.1f} px away)"
        )
    export.stated[:] = numbers(export)
    return template.format(
        *map(repr, export.stated),
        **vars(camera),
        name=re.sub(r"\W", "_", export.child),
        parent=export.parent,
        parent_=re.sub(r"\W", "_", export.parent),
        comment=re.sub("-(?=-)", "- ", export.comment),
        left=left,
        up=up,
        aperture_y=camera.height * ratio,
        offset_y=-up * ratio,
    )


mujoco = partial(_write, _MUJOCO, methodcaller("numbers", "wxyz:opengl"))
"""An MJCF camera; MuJoCo counts its principal point from there to the middle."""
isaac = partial(_write, _ISAAC, _by_column)
"""A USD camera; its matrix is for rows, and its offsets are to the right and up."""
sapien = partial(_write, _SAPIEN, _link)
"""The pose and the camera in Python, for ManiSkill as well."""
pybullet = partial(_write, _PYBULLET, partial(_by_column, inverse=True))
"""The two matrices of getCameraImage, by column."""
blender = partial(_write, _BLENDER, methodcaller("numbers", "matrix:opengl"))
"""A script that adds the camera and sets the size of images."""
