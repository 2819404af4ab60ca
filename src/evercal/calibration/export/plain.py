"""Plain numbers: OpenCV's rvec and tvec, 4x4 matrices as CSV, NPY and JSON."""

import io
import json

import numpy as np
from scipy.spatial.transform import Rotation

from evercal.calibration.export.request import Export, require_optical


def opencv(export: Export) -> str:
    """OpenCV's rvec and tvec for cv2.projectPoints, as cv2.FileStorage writes them.

    They take points of the parent frame to the camera, the inverse of every other format here.
    """
    import cv2

    require_optical(export, "opencv")
    camera_from_parent = export.pose.inverse()
    rotation = Rotation.from_quat(camera_from_parent.rotation_wxyz, scalar_first=True)
    mode = cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML
    storage = cv2.FileStorage(".yml", mode)
    storage.writeComment(f"rvec, tvec take points from {export.parent} to {export.child}, metres")
    storage.write("rvec", rotation.as_rotvec().reshape(3, 1))
    storage.write("tvec", camera_from_parent.translation_m.reshape(3, 1))
    camera = export.calibration.camera
    if camera is not None:
        storage.write("image_width", camera.width)
        storage.write("image_height", camera.height)
        storage.write("camera_matrix", camera.matrix())
        lens = camera.distortion or (0.0,) * 5
        storage.write("distortion_coefficients", np.array(lens).reshape(-1, 1))
    return storage.releaseAndGetString()


def csv(export: Export) -> str:
    """The 4x4 matrix parent_from_child, metres, a row a line."""
    rows = (export.pose.matrix() + 0.0).tolist()
    return "".join(",".join(map(repr, row)) + "\n" for row in rows)


def npy(export: Export) -> bytes:
    """The same as numpy's (4, 4) float64."""
    file = io.BytesIO()
    np.save(file, export.pose.matrix() + 0.0)
    return file.getvalue()


def as_json(export: Export) -> str:
    """The same with frame names, quaternion and covariance; `read_robot_poses` reads it too."""
    calibration = export.calibration
    record = {
        "parent_frame": export.parent,
        "child_frame": export.child,
        "meaning": calibration.meaning,
        "translation_m": export.pose.translation_m.tolist(),
        "quaternion_wxyz": export.pose.rotation_wxyz.tolist(),
        "matrix": export.pose.matrix().tolist(),
        "covariance": calibration.covariance.tolist(),
    }
    return json.dumps(record, indent=1, allow_nan=False) + "\n"
