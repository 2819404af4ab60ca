"""Move a calibration from the camera's optical frame to the driver's root frame.

tf is a tree: a camera driver publishes `camera_link` as the parent of its optical frames, which can
have no second parent. By ROS REP 103, a link has x forward, y left, z up, and an optical frame has
x right, y down, z forward. The offset between their origins is in `/tf_static` or the data sheet.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from evercal.errors import InputError
from evercal.geometry import SE3

_Transforms = dict[tuple[str, str], SE3]
_EXPECTED = "give what 'ros2 topic echo --once /tf_static' prints, or a TransformStamped"


def standard_link_from_optical(offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> SE3:
    """Return the pose of an optical frame whose origin lies forward, left, up in the link."""
    return SE3(np.array([0.5, -0.5, 0.5, -0.5]), np.array(offset_m))


def read_link_from_optical(path: str | os.PathLike[str], link: str, optical: str) -> SE3:
    """Read the pose of the optical frame in the driver's root frame from YAML or JSON.

    That is the output of `ros2 topic echo --once /tf_static`, a TransformStamped, or an object with
    `parent_frame`, `child_frame`, `translation_m`, `quaternion_wxyz`. Transforms are chained.
    """
    transforms: _Transforms = {}
    try:
        for document in yaml.safe_load_all(Path(path).read_text(encoding="utf-8")):
            transforms |= _transforms(document)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from None
    except (UnicodeDecodeError, yaml.YAMLError):
        raise InputError(f"{path}: neither YAML nor JSON; {_EXPECTED}") from None
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: a transform is incomplete ({error}); {_EXPECTED}") from None
    if not transforms:
        raise InputError(f"{path}: contains no transform; {_EXPECTED}")
    transforms |= {(child, parent): pose.inverse() for (parent, child), pose in transforms.items()}
    link_from, queue = {link: SE3.identity()}, [link]
    for frame in queue:
        for (parent, child), parent_from_child in transforms.items():
            if parent == frame and child not in link_from:
                link_from[child] = link_from[frame] @ parent_from_child
                queue.append(child)
    if optical not in link_from:
        frames = ", ".join(sorted({parent for parent, _ in transforms}))
        raise InputError(
            f"{path}: no transform leads from {link!r} to {optical!r}; its frames are {frames}."
            f" Name the optical frame with --child and the driver's root frame with --via"
        )
    return link_from[optical]


def _transforms(data: Any) -> _Transforms:
    if isinstance(data, Mapping) and "transforms" in data:
        data = data["transforms"]
    if isinstance(data, list):
        return {pair: pose for entry in data for pair, pose in _transforms(entry).items()}
    if isinstance(data, Mapping) and "transform" in data:
        body = data["transform"]
        pair = data["header"]["frame_id"], data["child_frame_id"]
        translation = [float(body["translation"][axis]) for axis in "xyz"]
        quaternion = [float(body["rotation"][axis]) for axis in "wxyz"]
    elif isinstance(data, Mapping) and "parent_frame" in data:
        pair = data["parent_frame"], data["child_frame"]
        translation, quaternion = data["translation_m"], data["quaternion_wxyz"]
    else:
        return {}
    if abs(float(np.linalg.norm(quaternion)) - 1.0) > 1e-2:
        raise ValueError(f"quaternion {quaternion} is not of length 1")
    parent, child = (str(frame).lstrip("/") for frame in pair)
    return {(parent, child): SE3(np.array(quaternion), np.array(translation))}
