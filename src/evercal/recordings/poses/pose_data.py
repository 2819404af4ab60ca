"""Poses in nested lists and objects, as JSON, YAML, NPZ and MATLAB files hold them.

Poses are lists of numbers, matrices, objects with named numbers, or rotations and translations
under two keys. They are in a list, under the names of images, or under a key.
"""

import re
from collections.abc import Mapping
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evercal.bounds import require_at_most
from evercal.recordings.images import IMAGE_ENDINGS
from evercal.recordings.poses.conventions import ConventionError, PoseConvention, pose_convention
from evercal.recordings.poses.pose_table import (
    PoseTable,
    named_numbers,
    names_position,
    plain_numbers,
)
from evercal.recordings.poses.row_files import name_and_unit, number_array, row_labels, text_cells

Array = NDArray[np.float64]

_KEYS = ("poses", "T", "transforms", "matrices", "samples", "pose", "matrix")
"""Keys of poses of anything."""
_ROLES = {
    True: re.compile(
        r"(base_from_gripper|robot_poses?|robot|tcp_poses?|gripper|end_effector|gripper2base"
        r"|effector_wrt_world|hand_world_samples|base2gripper|gripper_from_base)(?:_(.+))?"
    ),
    False: re.compile(
        r"(camera_from_board|camera_poses?|tracking|optical|board|marker|target2cam"
        r"|object_wrt_sensor|camera_marker_samples|cam2target|board_from_camera)(?:_(.+))?"
    ),
}
"""Words of the robot (True) or the camera, by OpenCV, MoveIt, easy_handeye and others."""
_INVERSE = ("base2gripper", "gripper_from_base", "cam2target", "board_from_camera")
_WIDTHS = (6, 7, 8, 12, 13, 16, 17)
"""Numbers of a pose, possibly after a stamp."""
_MATRICES = ((4, 4), (3, 4))
_LISTS = {
    "translation_m": ("x_m", "y_m", "z_m"),
    "quaternion_wxyz": ("qw", "qx", "qy", "qz"),
    "quaternion_xyzw": ("qx", "qy", "qz", "qw"),
}
"""Columns of lists."""
_ROTATION = re.compile(r"(?:rotation_matri(?:x|ces)|rotations?|rot|rmats?|rvecs?|rotvecs?|r)(_.*)?")
_TRANSLATION = re.compile(
    r"(?:translation_vectors?|translations?|trans|tvecs?|positions?|pos|t)(_.*)?"
)


def pose_data(data: Any, given: PoseConvention | None, robot: bool = True) -> PoseTable:
    """Poses of the robot, or else of the camera, in a convention or the one that keys define.

    ValueError: these are no poses, or it is not clear which ones.
    """
    return _table(_plain(data), given, robot)


def _plain(data: Any) -> Any:
    """Matrices of OpenCV and ViSP (rows, cols, data) as nested lists, and keys as text."""
    if isinstance(data, Mapping) and {"rows", "cols", "data"} <= data.keys():
        return number_array(data["data"], "data").reshape(data["rows"], data["cols"]).tolist()
    if isinstance(data, Mapping):
        return {str(key): _plain(value) for key, value in data.items()}
    nested = isinstance(data, list) and any(isinstance(each, Mapping) for each in data)
    return [_plain(each) for each in data] if nested else data


def _table(data: Any, given: PoseConvention | None, robot: bool) -> PoseTable:
    if isinstance(data, Mapping):
        return _of_object(data, given, robot)
    if isinstance(data, list) and data and all(isinstance(entry, list) for entry in data):
        numbers = _first(number_array(data, "a list of poses"), _MATRICES)
        if numbers.shape[-2:] == (6, 1):  # ViSP's vectors of poses
            numbers, given = numbers.reshape(-1, 6), given or pose_convention("ur")
        return plain_numbers(numbers[None] if numbers.shape in _MATRICES else numbers, given)
    if not isinstance(data, list) or not data or not all(isinstance(e, Mapping) for e in data):
        raise ValueError("poses are a list of objects, or of lists of numbers, not of both")
    if all(isinstance(entry.get("transforms"), list) for entry in data):  # messages of /tf
        return _table([each for entry in data for each in entry["transforms"]], given, robot)
    rows = [_flat(entry) for entry in data]
    keys = dict.fromkeys(key for row in rows for key in row)
    require_at_most(len(keys), "columns", "keys")
    require_at_most(len(keys) * len(rows), "numbers", "values")
    columns = _of_role({key: [row.get(key) for row in rows] for key in keys}, given, robot)
    frames = sorted({str(frame) for frame in columns.get("child_frame_id", ())})
    if frames[1:]:
        raise ValueError(f"it holds poses of {' and '.join(frames)}; keep those of one frame")
    table = _of_arrays(columns, given, plural=False)
    if table is not None:
        return table
    rows = [_cells({key: columns[key][i] for key in columns}) for i in range(len(rows))]
    words = [*dict.fromkeys(word for row in rows for word in row)]
    require_at_most(len(words) * len(rows), "numbers", "values")
    cells = text_cells([str(row.get(word)) for word in words] for row in rows)
    table = _labelled(named_numbers(words, cells, given), columns, plural=False)
    return table._replace(fixed="quaternion_wxyz" in columns)


def _of_object(data: Mapping[str, Any], given: PoseConvention | None, robot: bool) -> PoseTable:
    stems = {re.sub(r"\d+", "", key) if re.search(r"\d", key) else key for key in data}
    images = all(key.lower().endswith(IMAGE_ENDINGS) for key in data)
    if data and (images or (len(stems) == 1 and not stems & data.keys())):
        return _table([*data.values()], given, robot)._replace(names=tuple(data))
    stated = data.get("parameters")
    stated = stated if isinstance(stated, Mapping) and robot else {}
    fixed = stated.get("eye_on_hand") is False or stated.get("calibration_type") == "eye_on_base"
    if fixed and not (given and given.has("inverse")):
        problem = "easy_handeye states gripper_from_base if the camera is fixed"
        raise ConventionError(problem, "wxyz:inverse")
    columns = _of_role(data, given, robot)
    inner = [key for key in columns if key in _KEYS and _is_nested(columns[key])]
    if len(inner) == 1:
        return _labelled(_table(columns[inner[0]], given, robot), columns, plural=True)
    nested = any(_shape(value)[1:] for value in columns.values())
    table = _of_arrays(columns, given, plural=True) if nested else None
    if table is not None:
        return table
    if names_position([*_cells(_flat(columns))]):
        return _table([columns], given, robot)
    lists = [[*v.values()] if isinstance(v, Mapping) else v for v in columns.values()]
    if names_position([*columns]) and all(isinstance(each, list) for each in lists):
        rows = [dict(zip(columns, row, strict=True)) for row in zip(*lists, strict=True)]
        return _table(rows, given, robot)
    raise _unclear([], data)


def _is_nested(value: object) -> bool:
    return isinstance(value, Mapping) or (
        isinstance(value, list) and all(isinstance(each, Mapping) for each in value)
    )


def _unclear(keys: list[str], data: Mapping[str, Any]) -> ValueError:
    return ValueError(
        f"{' and '.join(keys) or 'none'} of its keys ({', '.join(data)}) may hold the poses;"
        f" call the right one 'poses'"
    )


def _of_role(
    columns: Mapping[str, Any], given: PoseConvention | None, robot: bool
) -> Mapping[str, Any]:
    """Columns of the robot or of the camera without that word, and of neither."""
    own, others = {}, {}
    for key, value in columns.items():
        first, _, last = key.partition("_")
        for role, pattern in _ROLES.items():
            match = pattern.fullmatch(key) or pattern.fullmatch(last)
            if match is None:
                continue
            if role == robot:
                rest = match[2] or ("pose" if match.string == key else first)
                if rest in own:
                    raise _unclear([*columns], columns)
                own[rest] = value
                if match[1] in _INVERSE and not (given and given.has("inverse")):
                    raise ConventionError(f"{key} is the inverse pose", "such as matrix:inverse")
            break
        else:
            others[key] = value
    return others | own if own else columns


def _of_arrays(
    columns: Mapping[str, Any], given: PoseConvention | None, plural: bool
) -> PoseTable | None:
    """Poses of a key that holds arrays, or of keys for rotations and translations."""
    keys = [key for key in columns if key in _KEYS and len(_shape(columns[key])) > 1]
    for key, value in {} if keys else columns.items():
        shape = _shape(value)
        table = len(shape) == 2 and shape[1] in _WIDTHS and "joint" not in key.lower()
        matrices = shape[-2:] in _MATRICES or shape[:2] in _MATRICES
        keys += [key] if (table and plural) or matrices else []
    plain = {key: name_and_unit(key)[0] for key in columns}
    parts = [
        (first, second)
        for first, second in product(columns, columns)
        if len(_shape(columns[first])) > 1 and len(_shape(columns[second])) > (not plural)
        if (r := _ROTATION.fullmatch(plain[first]))
        if (t := _TRANSLATION.fullmatch(plain[second])) and r[1] == t[1]
    ]
    parts = [] if {*keys} & {*_KEYS} else parts
    if len(keys) + len(parts) > 1:
        raise _unclear(keys + [f"{r} with {t}" for r, t in parts], columns)
    if keys:
        return _labelled(_table(columns[keys[0]], given, True), columns, plural)
    if not parts:
        return None
    labels = {key: value for key, value in columns.items() if key not in parts[0]}
    return _labelled(_composed(columns, *parts[0], given), labels, plural)


def _composed(
    columns: Mapping[str, Any], rotation: str, translation: str, given: PoseConvention | None
) -> PoseTable:
    unit = name_and_unit(translation)[1] or "m"
    second = _rows(number_array(columns[translation], repr(translation)), 3)
    first = _first(number_array(columns[rotation], repr(rotation)), ((3, 3),))
    width = first.size // max(len(second), 1)
    if width == 9 and first.size == 9 * len(second):
        matrices = np.concatenate([first.reshape(-1, 3, 3), second[..., None]], -1)
        return plain_numbers(matrices, given or pose_convention(f"matrix:{unit}"))
    kind = "rvec_" if "vec" in rotation.lower() else {3: "rotation_", 4: "q"}.get(width, "")
    words = [f"{axis}_{unit}" for axis in "xyz"] + [
        f"{kind}{axis}" for axis in ("xyz", "1234")[width == 4]
    ]
    numbers = np.concatenate([second, _rows(first, width)], -1)
    return named_numbers(words, text_cells([map(repr, row) for row in numbers.tolist()]), given)


def _rows(array: Array, width: int) -> Array:
    """(n, width) numbers of arrays with an axis too many, or with the poses last as in MATLAB."""
    array = np.squeeze(array)
    turned = array.ndim == 2 and array.shape[1] != width == array.shape[0]
    return (array.T if turned else array).reshape(-1, width)


def _first(array: Array, shapes: tuple[tuple[int, int], ...]) -> Array:
    """(n, rows, columns) matrices of an array that has the poses last, as in MATLAB."""
    if array.ndim != 3 or array.shape[:2] not in shapes:
        return array
    block = array[..., :3, :3]
    whole = array.shape[1:] in shapes and np.allclose(
        np.swapaxes(block, 1, 2) @ block, np.eye(3), atol=0.01
    )
    return array if whole else np.moveaxis(array, -1, 0)


def _labelled(table: PoseTable, columns: Mapping[str, Any], plural: bool) -> PoseTable:
    lists = {key: value for key, value in columns.items() if isinstance(value, list)}
    names, stamps, _ = row_labels([*lists], [*lists.values()], len(table.numbers), plural)
    stamps = stamps if table.stamps_s is None else table.stamps_s
    return table._replace(names=table.names or names, stamps_s=stamps)


def _flat(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Values of nested objects; the stamp of a ROS message as seconds."""
    cells: dict[str, Any] = {}
    for key, value in entry.items():
        require_at_most(len(key), "name_characters", "characters of a key")
        if key == "stamp" and isinstance(value, Mapping) and len(value) == 2:
            seconds, nanoseconds = value.values()
            cells["stamp_s"] = seconds + 1e-9 * nanoseconds
        elif isinstance(value, Mapping):
            cells |= {f"{key}_{inner}": each for inner, each in _flat(value).items()}
        else:
            cells[key] = value
    return cells


def _cells(row: Mapping[str, Any]) -> dict[str, object]:
    """One value a column: those of a list are columns of their own."""
    cells: dict[str, object] = {}
    for key, value in row.items():
        values = value if isinstance(value, list) else [value]
        require_at_most(len(values), "columns", "numbers of one key")
        names = [f"{key}_{i}" for i in range(len(values))] if values is value else [key]
        cells |= dict(zip(_LISTS.get(key, names), values, strict=False))
    return cells


def _shape(value: object) -> tuple[int, ...]:
    """Lengths of nested lists, by the first of each: all are compared when numbers are read."""
    return (len(value), *_shape(value[0] if value else None)) if isinstance(value, list) else ()
