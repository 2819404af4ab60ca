"""Poses of the camera in the base, image by image: TUM, COLMAP, nerfstudio.

A fixed camera has one pose, which every image gets that it was calibrated from. A camera on the arm
has one for every pose of the robot, which must be given. COLMAP and nerfstudio count pixels from
the corner of the first one, so that the principal point is half a pixel larger there than here:
COLMAP says so, nerfstudio takes COLMAP's numbers and adds half a pixel to its own coordinates.
Checked against pycolmap, and against nerfstudio's data conventions, parser and `Cameras`.
"""

import json

from evercal.calibration.export.request import CameraViews, Export, camera_views
from evercal.errors import InputError
from evercal.geometry import Camera
from evercal.recordings.poses.conventions import CONVENTIONS, numbers_from_poses, pose_convention


def tum(export: Export) -> str:
    """Lines of stamp, translation in metres, quaternion x y z w: base_from_camera."""
    views = camera_views(export, "tum")
    fixed = export.calibration.mount == "eye_to_hand"
    numbers = numbers_from_poses(views.base_from_camera, CONVENTIONS["xyzw"]) + 0.0
    lines = [
        " ".join(map(repr, [stamp, *row]))
        for stamp, row in zip(views.stamps_s.tolist(), numbers.tolist(), strict=True)
    ]
    return "\n".join(["# timestamp tx ty tz qx qy qz qw", *(lines[:1] if fixed else lines), ""])


def colmap(export: Export) -> dict[str, str]:
    """A sparse model without points: camera_from_base, quaternion w x y z.

    Raises:
        InputError: No intrinsics, no robot poses for a camera on the arm, or a file name with a
            blank in it, which COLMAP's text format cannot hold.
    """
    camera = _camera(export, "colmap")
    views = camera_views(export, "colmap")
    for name in views.names:
        if len(name.split()) != 1:
            raise InputError(f"colmap: image name {name!r} has a blank in it; rename the image")
    numbers = numbers_from_poses(views.base_from_camera, pose_convention("wxyz:inverse")) + 0.0
    lines = []
    for i, (name, row) in enumerate(zip(views.names, numbers.tolist(), strict=True)):
        pose = " ".join(map(repr, [*row[3:], *row[:3]]))
        lines += [f"{i + 1} {pose} 1 {name}", ""]
    model, parameters = _colmap_lens(camera)
    numbers = " ".join(map(repr, parameters))
    return {
        "cameras.txt": "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
        f"1 {model} {camera.width} {camera.height} {numbers}\n",
        "images.txt": "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n"
        "# POINTS2D[] as (X, Y, POINT3D_ID)\n" + "\n".join([*lines, ""]),
        "points3D.txt": "# no points\n",
    }


def nerfstudio(export: Export) -> str:
    """transforms.json: base_from_camera with camera axes x right, y up, z back.

    Raises:
        InputError: No intrinsics, a lens that nerfstudio has no terms for, or no robot poses for a
            camera on the arm.
    """
    camera = _camera(export, "nerfstudio")
    views = camera_views(export, "nerfstudio")
    k1, k2, p1, p2, k3, *rational = camera.coefficients
    if any(rational):
        # Its k4 is the fourth power of a polynomial, not OpenCV's k4.
        raise InputError(
            "nerfstudio has no terms for k4 k5 k6 of this lens; calibrate it with k1 k2 p1 p2 k3,"
            " or undistort the images"
        )
    record = {
        "camera_model": "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + 0.5,
        "cy": camera.cy + 0.5,
        "k1": k1,
        "k2": k2,
        "k3": k3,
        "k4": 0.0,
        "p1": p1,
        "p2": p2,
        "frames": _nerfstudio_frames(views),
    }
    return json.dumps(record, indent=1, allow_nan=False) + "\n"


def _nerfstudio_frames(views: CameraViews) -> list[dict[str, object]]:
    numbers = numbers_from_poses(views.base_from_camera, pose_convention("matrix:opengl")) + 0.0
    return [
        {"file_path": name, "transform_matrix": row.reshape(4, 4).tolist()}
        for name, row in zip(views.names, numbers, strict=True)
    ]


def _camera(export: Export, form: str) -> Camera:
    camera = export.calibration.camera
    if camera is None:
        raise InputError(f"{form} needs intrinsics, and this calibration holds none")
    return camera


def _colmap_lens(camera: Camera) -> tuple[str, list[float]]:
    """COLMAP's model and its numbers."""
    pinhole = [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5]
    if not any(camera.distortion):
        return "PINHOLE", pinhole
    if len(camera.distortion) == 4:
        return "OPENCV", [*pinhole, *camera.distortion]
    return "FULL_OPENCV", [*pinhole, *camera.coefficients]
