"""What an exporter wrote is parsed again, and its pose and frames are compared."""

import ast
import io
import json
import re
import shlex
from collections.abc import Callable, Iterable
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from evercal.calibration.export.request import pose_numbers
from evercal.geometry import SE3, pose_distance
from evercal.recordings.poses.conventions import pose_convention, poses_from_numbers
from evercal.storage.text_files import library_errors

_TOLERANCE = 1e-6
"""Metres and radians, and share of a length; robot controllers get nine decimals."""
_NO_POSE = re.compile(r"^(?:[#;!%]| +rows:| +cols:).*$", re.MULTILINE)
"""Comments of files of numbers, and sizes in OpenCV's."""
_WORD = re.compile(r"[\w./+-]+")
_NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:e[-+]?\d+)?")


def _of_python(text: str) -> list[object]:
    nodes = ast.walk(ast.parse(text))
    return [node.value for node in nodes if isinstance(node, ast.Constant)]


def _of_xml(text: str) -> list[dict[str, str]]:
    return [element.attrib for element in ElementTree.fromstring(text).iter()]


def _of_yaml(text: str) -> object:
    return yaml.load(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader))


_PARSERS: dict[str, Callable[[Any], object]] = {
    ".json": json.loads,
    ".yaml": _of_yaml,
    ".calib": _of_yaml,
    ".launch.py": _of_python,
    ".launch": _of_xml,
    ".urdf": _of_xml,
    ".sh": shlex.split,
    ".npy": lambda data: np.load(io.BytesIO(data)).tolist(),
    "": lambda files: files["images.txt"],
}
"""By ending; other files are lines of numbers."""


def require_read_back(
    content: object, ending: str, convention: str, pose: SE3, frames: Iterable[str]
) -> None:
    """Refuse content that does not state a pose in a convention, and names of frames."""
    with library_errors("it would not be read as it is meant; report this"):
        parsed = _PARSERS.get(ending, str)(content)
        if not isinstance(parsed, str):
            parsed = json.dumps(parsed)
        words = _WORD.findall(_NO_POSE.sub("", parsed))
        for frame in frames:
            if frame not in words:
                raise ValueError(f"frame {frame} is not in it")
        numbers = np.array([float(word) for word in words if _NUMBER.fullmatch(word)])
        first = 0
        if ending in ("", ".yml"):  # COLMAP and OpenCV have the rotation first
            first = 3
        wanted = np.roll(pose_numbers(pose, convention), -first)
        windows = np.lib.stride_tricks.sliding_window_view(numbers, len(wanted))
        nearest = windows[np.abs(windows - wanted).max(axis=1).argmin()]
        read = poses_from_numbers(np.roll(nearest, first), pose_convention(convention))
        most = _TOLERANCE * (1 + np.linalg.norm(pose.translation_m))
        if max(pose_distance(read, pose)) > most:
            raise ValueError(f"its numbers are {nearest.tolist()}")
