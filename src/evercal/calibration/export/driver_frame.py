"""From the camera's optical frame to the driver's root frame.

tf is a tree: a camera driver already publishes `camera_link` above its optical frames, so a
calibration that names an optical frame as child would give it two parents. What fits into the tree
is parent_from_link = parent_from_optical @ optical_from_link. By convention (ROS REP 103) a link
has x forward, y left, z up and an optical frame x right, y down, z forward. Where its origin lies
in the link differs from camera to camera and must be known, from `/tf_static` or a data sheet.
"""

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from evercal.calibration.calibration import Calibration
from evercal.errors import InputError
from evercal.geometry import SE3

LINK_FROM_OPTICAL_WXYZ = (0.5, -0.5, 0.5, -0.5)
"""The usual rotation: z forward becomes x forward."""

Edges = dict[tuple[str, str], SE3]


def standard_link_from_optical(
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> SE3:
    """With the usual rotation.

    Args:
        offset_m: origin of the optical frame in the link: forward, left, up.
    """
    return SE3(np.array(LINK_FROM_OPTICAL_WXYZ), np.array(offset_m))


def published_at(calibration: Calibration, link: str, link_from_optical: SE3) -> Calibration:
    """The same calibration, told of the driver's root frame.

    Args:
        calibration: of the optical frame.
        link: name of the driver's root frame.
        link_from_optical: pose of the optical frame in it.

    Returns:
        With `link` as child; its covariance is that of the link's pose, lever arm included.

    Raises:
        InputError: `link` is the parent's name.
    """
    if link == calibration.parent_frame:
        raise InputError(f"driver's root frame and parent frame are both called {link!r}")
    optical_from_link = link_from_optical.inverse()
    parent_from_optical = calibration.parent_from_child
    # d(t + R exp(w) a) = dt + R (w x a), and exp(w) R_a = R_a exp(R_a^T w).
    jacobian = np.eye(6)
    cross = np.cross(np.eye(3), optical_from_link.translation_m).T  # times w is w x a
    jacobian[:3, 3:] = parent_from_optical.rotation_matrix() @ cross
    jacobian[3:, 3:] = optical_from_link.rotation_matrix().T
    covariance = jacobian @ calibration.covariance @ jacobian.T
    return replace(
        calibration,
        parent_from_child=parent_from_optical @ optical_from_link,
        covariance=(covariance + covariance.T) / 2,
        child_frame=link,
    )


def read_link_from_optical(path: str | os.PathLike[str], link: str, optical: str) -> SE3:
    """Reads where the optical frame lies in the driver's root frame.

    Args:
        path: YAML or JSON: what `ros2 topic echo --once /tf_static` prints, a TransformStamped, or
            an object with `parent_frame`, `child_frame`, `translation_m`, `quaternion_wxyz`.
            Several transforms are chained, in either direction.
        link: the driver's root frame.
        optical: the optical frame.

    Raises:
        InputError: The file is missing, holds no transforms, or none that lead from one frame to
            the other.
    """
    path = Path(path)
    import yaml

    try:
        documents = [*yaml.safe_load_all(path.read_text(encoding="utf-8"))]
    except FileNotFoundError:
        raise InputError(f"{path}: file of transforms is missing; check the path") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except (UnicodeDecodeError, yaml.YAMLError):
        raise InputError(f"{path}: neither YAML nor JSON; {_EXPECTED}") from None
    edges: Edges = {}
    try:
        for document in documents:
            edges |= _edges(document)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: a transform is incomplete ({error}); {_EXPECTED}") from None
    if not edges:
        raise InputError(f"{path}: no transform in it; {_EXPECTED}")
    found = _chain(edges, link, optical)
    if found is None:
        known = ", ".join(sorted({frame for pair in edges for frame in pair}))
        raise InputError(
            f"{path}: no transform leads from {link!r} to {optical!r}; it knows {known}. Name the"
            f" optical frame with --child and the driver's root frame with --via"
        )
    return found


_EXPECTED = "give what 'ros2 topic echo --once /tf_static' prints, or a TransformStamped"


def _edges(data: Any) -> Edges:
    """The transforms of a document as parent_from_child by (parent, child)."""
    if isinstance(data, Mapping) and "transforms" in data:
        data = data["transforms"]
    if isinstance(data, list):
        return {pair: pose for entry in data for pair, pose in _edges(entry).items()}
    if not isinstance(data, Mapping):
        return {}
    if "transform" in data:
        body = data["transform"]
        pair = data["header"]["frame_id"], data["child_frame_id"]
        translation = [float(body["translation"][axis]) for axis in "xyz"]
        quaternion = [float(body["rotation"][axis]) for axis in "wxyz"]
    elif "parent_frame" in data:
        pair = data["parent_frame"], data["child_frame"]
        translation, quaternion = data["translation_m"], data["quaternion_wxyz"]
    else:
        return {}
    if abs(float(np.linalg.norm(quaternion)) - 1.0) > 1e-2:
        raise ValueError(f"quaternion {quaternion} is not of length 1")
    parent, child = (str(frame).lstrip("/") for frame in pair)
    return {(parent, child): SE3(np.array(quaternion), np.array(translation))}


def _chain(edges: Edges, start: str, end: str) -> SE3 | None:
    """start_from_end along the transforms, each in either direction."""
    steps = edges | {(child, parent): pose.inverse() for (parent, child), pose in edges.items()}
    reached = {start: SE3.identity()}
    queue = [start]
    for frame in queue:
        for (here, there), here_from_there in steps.items():
            if here == frame and there not in reached:
                reached[there] = reached[frame] @ here_from_there
                queue.append(there)
    return reached.get(end)
