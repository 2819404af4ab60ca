"""The cameras in nested entries, each with all numbers of the file that may be about it.

A block is a camera if it states a focal length or an intrinsic matrix. Other values go to the
cameras whose names hold all words of theirs: `rgbDistortion` to `rgbIntrinsic`, `LEFT_DISTO` to
`LEFT_CAM_HD`, `D1` to `M1`, `lens` to all. Values that no camera takes keep the names that lead to
them, such as `optics.a`, so that numbers of unknown meaning are refused by name.
"""

import re
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

from evercal.recordings.cameras.camera_names import (
    DISTORTION,
    FIELDS,
    MODEL_NAMES,
    field_name,
    is_array,
    is_harmless,
)
from evercal.recordings.cameras.camera_notations import value_of
from evercal.recordings.cameras.field_of_view import has_view
from evercal.typing import JsonObject

_WORD = re.compile(r"\[\d+\]|[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
_NEUTRAL = frozenset(
    re.findall(
        r"\w+",
        "camera cameras cam image images img lens matrix mat k d m data model type intrinsic"
        " intrinsics parameter parameters params param calibration calib internal coefficient"
        " coefficients coeffs coeff coefs coef distortion distortions dist disto radial tangential"
        " resolution size info values value sensor optical optics stream frame projection main",
    )
)
"""Words of names that do not distinguish cameras."""
_SAME = {"color": "rgb", "colour": "rgb", "l": "left", "r": "right", "infrared": "ir"}
"""Words that mean the same."""
_OF_ARRAYS = ("camera_matrix", "distortion_coefficients", "image_size")
"""Fields that are arrays beside a word such as `1` or `left`."""
_OF_ONE_CAMERA = ("camera_matrix", "fx", "fy", "cx", "cy")
"""Fields that hold for the camera of their block only."""
_SHORT = {"m": "camera_matrix", "s": "image_size"}
"""Fields by names that mean them only beside a word such as `1` or `left`."""


_MOST_CAMERAS = 500


class _Value(NamedTuple):
    path: str
    """Names that lead to it, with points between them."""
    home: tuple[str, frozenset[str]]
    """Block, and the words of its own name that distinguish cameras."""
    field: str
    words: frozenset[str]
    """All words of the path that distinguish cameras."""
    value: Any


def cameras_of(data: object) -> dict[str, JsonObject]:
    """Fields of all cameras by the names of their blocks."""
    values = []
    homes: dict[Any, list[_Value]] = {}
    for path, entry in _leaves(data, ""):
        block, _, leaf = path.rpartition(".")
        field, words = _role(leaf, entry)
        told = words | _told(_WORD.findall(block))
        value = _Value(path, (block, words), field, told, entry)
        values.append(value)
        homes.setdefault(value.home, []).append(value)
    cameras = {}
    views = {}
    for home, own in homes.items():
        fields = {value.field: value.value for value in own}
        if "fx" in fields or is_array(fields.get("camera_matrix")):
            cameras[home] = own
        elif has_view(fields):
            views[home] = own
    cameras = cameras or views
    if len(cameras) > _MOST_CAMERAS:
        raise ValueError(f"holds {len(cameras)} cameras; give a file of the right one")
    told = [own[0].words for own in cameras.values()]
    loose: list[tuple[_Value, bool]] = []
    for value in values:
        if value.home not in cameras:
            loose.append((value, any(map(value.words.issubset, told))))
    alone = len(cameras) == 1
    return dict(_fields(home, own, loose, alone) for home, own in cameras.items())


def _leaves(value: Any, path: str) -> Iterator[tuple[str, Any]]:
    """Values of nested entries with the names that lead to them."""
    if isinstance(value, str) and isinstance(value_of(value), list):
        value = value_of(value)
    parts: JsonObject = {}
    if isinstance(value, dict) and not is_array(value):
        for name, entry in value.items():
            # Of our own files, which hold much else.
            ours = str(value.get("format")).startswith("evercal")
            if not ours or name in ("camera", "cameras"):
                parts[f"{path}.{name}".lstrip(".")] = entry
    elif isinstance(value, list):
        sizes = field_name(path.rpartition(".")[2]) == "image_size"
        for i, entry in enumerate(value):
            name = i
            if (
                isinstance(entry, list)
                and len(entry) == 2
                and isinstance(entry[1], dict)
            ):
                name, entry = entry  # pairs, as a map of C++ in JSON
            if isinstance(entry, dict):
                name = entry.get("name") or entry.get("class") or name
            if isinstance(entry, dict) or (sizes and isinstance(entry, list)):
                parts[f"{path}[{name}]"] = entry
    if not parts:
        yield path, value
    for name, entry in parts.items():
        yield from _leaves(entry, name)


def _role(key: str, value: Any) -> tuple[str, frozenset[str]]:
    """The field that a name means but for some words, and these words."""
    field = field_name(key)
    listed = is_array(value)
    if (field in FIELDS and not (listed and field in DISTORTION[1:])) or is_harmless(
        key
    ):
        return field, frozenset()
    words = _WORD.findall(key)
    for i in range(1, len(words)):
        for own, others in ((words[i:], words[:i]), (words[:i], words[i:])):
            name = "".join(own)
            meant = _SHORT.get(name.lower(), field_name(name))
            if meant in FIELDS and listed == (meant in _OF_ARRAYS):
                return meant, _told(others)
    return key, frozenset()


def _told(words: Iterable[str]) -> frozenset[str]:
    """Words that distinguish a camera."""
    lower = {word.lower() for word in words}
    return frozenset({_SAME.get(word, word) for word in lower - _NEUTRAL})


def _fields(
    home: Any, own: list[_Value], loose: list[tuple[_Value, bool]], alone: bool
) -> tuple[str, JsonObject]:
    """Name and fields of one camera; `loose` are values outside of cameras, and if one has them."""
    told = own[0].words
    fields: JsonObject = {}
    for value in own:
        leaf = value.path.rpartition(".")[2]
        fields[value.field if home[1] else leaf] = value.value
    hidden = {*_OF_ONE_CAMERA, *(value.field for value in own)}
    if not hidden.isdisjoint(DISTORTION):
        hidden.update(DISTORTION)
    for value, is_taken in loose:
        block = value.home[0]
        is_lens = value.field in DISTORTION or value.field in MODEL_NAMES
        beside = block not in home[0]
        sure = value.words <= told and (value.field in FIELDS or is_lens or not beside)
        if is_taken and not value.words <= told:
            continue
        if value.field in hidden and not (beside and is_lens):
            continue
        if fields.get(value.field) == value.value:
            continue
        if beside and is_lens and not (alone or value.words):
            sure = False
        name = value.field if sure and value.field not in hidden else value.path
        fields[name] = value.value
    names = [value.path for value in own if value.field in (*_OF_ARRAYS[:2], "fx")]
    named = " ".join(names) or "camera"
    return named if home[1] or not home[0] else home[0], fields
