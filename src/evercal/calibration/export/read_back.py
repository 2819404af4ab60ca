"""What an exporter wrote is parsed again, and its numbers and frames are compared."""

import json
import re
import shlex
from collections.abc import Callable
from functools import partial
from xml.etree import ElementTree

import numpy as np
import yaml

from evercal.calibration.export.request import Export
from evercal.storage.text_files import library_errors

_COMMENT = re.compile(r"^[#;!].*$", re.MULTILINE)
_WORD = re.compile(r"[\w./+-]+")
_NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:e[-+]?\d+)?")
_ROUNDING = 1e-8
"""Robot controllers get nine decimals."""


def _of_xml(text: str) -> list[dict[str, str]]:
    return [element.attrib for element in ElementTree.fromstring(text).iter()]


_PARSERS: dict[str, Callable[[str], object]] = {
    ".json": json.loads,
    ".yaml": yaml.safe_load,
    ".calib": yaml.safe_load,
    ".launch.py": partial(shlex.split, comments=True),
    ".launch": _of_xml,
    ".xml": _of_xml,
    ".urdf": _of_xml,
    ".sh": shlex.split,
}
"""By ending; other files are lines of numbers."""


def require_read_back(text: str, ending: str, export: Export, tf: bool) -> None:
    """Refuse a text without the numbers of the pose in a row, or, for tf, names of its frames."""
    with library_errors("it would not be read as it is meant; report this"):
        parsed = _COMMENT.sub("", text)
        if ending in _PARSERS:
            parsed = json.dumps(_PARSERS[ending](text))
        words = _WORD.findall(parsed)
        if tf and not {export.parent, export.child} <= {*words}:
            raise ValueError("it lacks a frame")
        numbers = np.array([float(word) for word in words if _NUMBER.fullmatch(word)])
        count = len(export.stated)
        windows = np.lib.stride_tricks.sliding_window_view(numbers, count)
        if np.abs(windows - export.stated).max(axis=1).min() > _ROUNDING:
            raise ValueError(f"the numbers {export.stated} are not in it")
