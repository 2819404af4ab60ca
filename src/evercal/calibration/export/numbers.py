"""Formats that hold one pose as numbers: matrices, OpenCV, Zivid and robot controllers.

The conventions of the robots are in `evercal.recordings.poses.conventions`. Zivid's format was
checked against the file that its Python samples write and its SDK loads.
"""

import io
import json
from collections.abc import Callable

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from evercal.calibration.export.request import Export


def opencv(export: Export) -> str:
    """Write rvec and tvec for cv2.projectPoints in the format of cv2.FileStorage.

    They map points from the parent frame to the camera, the inverse of every other format.
    """
    import cv2

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
        distortion = camera.distortion or (0.0,) * 5
        storage.write("distortion_coefficients", np.array(distortion).reshape(-1, 1))
    return storage.releaseAndGetString()


def csv(export: Export) -> str:
    """Write the 4x4 matrix parent_from_child in metres."""
    rows = (export.pose.matrix() + 0.0).tolist()
    return "".join(",".join(map(repr, row)) + "\n" for row in rows)


def npy(export: Export) -> bytes:
    """Write the same matrix as a numpy array (4, 4) of float64."""
    file = io.BytesIO()
    np.save(file, export.pose.matrix() + 0.0)
    return file.getvalue()


def as_json(export: Export) -> str:
    """Write matrix, quaternion, covariance and frame names; `read_robot_poses` reads them."""
    names = ("parent_frame", "child_frame", "meaning", "translation_m", "quaternion_wxyz", "matrix")
    whole = export.calibration.to_dict()
    record = {name: whole[name] for name in (*names, "covariance")}
    return json.dumps(record, indent=1, allow_nan=False) + "\n"


def zivid(export: Export) -> str:
    """Write the 4x4 matrix in millimetres as YAML."""
    rows = np.reshape(export.numbers("matrix:mm"), (4, 4)).tolist()
    record = {"__version__": {"serializer": 1, "data": 1}, "FloatMatrix": {"Data": rows}}
    return yaml.safe_dump(record, sort_keys=False, default_flow_style=None)


def franka(export: Export) -> str:
    """Write 16 numbers column by column in metres, like libfranka's O_T_EE, as JSON."""
    return json.dumps(export.numbers("franka")) + "\n"


def _controller(convention: str, text: str) -> Callable[[Export], str]:
    def write(export: Export) -> str:
        # Nine decimals and no exponents, which some controllers cannot parse.
        numbers = [f"{round(value, 9) + 0.0:.9f}" for value in export.numbers(convention)]
        return text.format(*numbers, c=export.comment)

    return write


ur = _controller("ur", "# {c}\np[{}, {}, {}, {}, {}, {}]\n")
kuka = _controller("kuka", "; {c}\n{{X {}, Y {}, Z {}, A {}, B {}, C {}}}\n")
abb = _controller("abb", "! {c}\n[[{},{},{}],[{},{},{},{}]]\n")
fanuc = _controller("fanuc", "# {c}\nX Y Z W P R\n{} {} {} {} {} {}\n")
yaskawa = _controller("yaskawa", "# {c}\nX Y Z Rx Ry Rz\n{} {} {} {} {} {}\n")
staubli = _controller("staubli", "# {c}\nX Y Z RX RY RZ\n{} {} {} {} {} {}\n")
