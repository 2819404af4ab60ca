"""Poses in nested lists and objects, as JSON, YAML, NPZ and MATLAB files hold them.

Poses are lists of numbers, matrices, objects with named numbers, or rotations and translations
under two keys. They are in a list, under the names of images, or under a key.
"""

import re
from collections.abc import Mapping
from itertools import product
from typing import Any

import numpy as np

from evercal.bounds import require_at_most
from evercal.recordings.images import IMAGE_ENDINGS
from evercal.recordings.poses.conventions import (
    ConventionError,
    PoseConvention,
    pose_convention,
)
from evercal.recordings.poses.pose_table import (
    HEADERS,
    PoseTable,
    has_position,
    named_numbers,
    plain_numbers,
)
from evercal.recordings.poses.row_files import (
    name_and_unit,
    number_array,
    row_labels,
    text_cells,
)
from evercal.typing import Array

Columns = Mapping[str, Any]
"""Values by key: of one pose, or lists of the values of all poses."""

_KEYS = ("poses", "T", "transforms", "matrices", "samples", "pose", "matrix")
"""Keys of poses of anything."""
_ROLES = [
    re.compile(rf"(?:{words})(?:_(.+))?|(.+)_(?:{words})")
    for words in (
        "camera_from_board|camera_poses?|tracking|optical|board|marker|target2cam"
        "|object_wrt_sensor|camera_marker_samples",
        "base_from_gripper|robot_poses?|robot|tcp_poses?|gripper|end_effector|gripper2base"
        "|effector_wrt_world|hand_world_samples",
    )
]
"""Keys of the camera, then of the robot; among others OpenCV's, MoveIt's and easy_handeye's."""
_INVERSE = re.compile("base2gripper|gripper_from_base|cam2target|board_from_camera")
_WIDTHS = (6, 7, 8, 12, 13, 16, 17)
"""Numbers of a pose, possibly after a stamp."""
_MATRICES = ((4, 4), (3, 4))
_LISTS = {
    "translation_m": ("x_m", "y_m", "z_m"),
    "xyz": "xyz",
    "rpy": ("roll", "pitch", "yaw"),
}
"""Columns of lists."""
_ROTATION = re.compile(
    r"(?:rotation_matri(?:x|ces)|rotations?|rot|rmats?|rvecs?|rotvecs?|r)(_.*)?"
)
_TRANSLATION = re.compile(
    r"(?:translation_vectors?|translations?|tvecs?|positions?|pos|t)(_.*)?"
)


def pose_data(data: Any, given: PoseConvention | None, robot: bool = True) -> PoseTable:
    """Poses of the robot, or else of the camera, in a convention or the one that keys define.

    ValueError: these are no poses, or it is not clear which ones.
    """
    data = _plain(data)
    if isinstance(data, Mapping):
        return _of_object(data, given, robot)
    if (
        not isinstance(data, list)
        or len({isinstance(each, Mapping) for each in data}) != 1
    ):
        raise ValueError(
            "poses are a list of objects, or of lists of numbers, not of both"
        )
    if not isinstance(data[0], Mapping):
        numbers = _first(number_array(data, "a list of poses"), _MATRICES)
        if numbers.shape[-2:] == (6, 1):  # ViSP's vectors of poses
            numbers = numbers.reshape(-1, 6)
            given = given or pose_convention("ur")
        single = numbers.ndim == 1 or numbers.shape in _MATRICES
        return plain_numbers(numbers[None] if single else numbers, given)
    # Messages of /tf.
    if all(isinstance(entry.get("transforms"), list) for entry in data):
        data = [each for entry in data for each in entry["transforms"]]
    rows = [_flat(entry) for entry in data]
    keys = dict.fromkeys(key for row in rows for key in row)
    require_at_most(len(keys), "columns", "keys")
    require_at_most(len(keys) * len(rows), "numbers", "values")
    columns = _of_role(
        {key: [row.get(key) for row in rows] for key in keys}, given, robot
    )
    frames = sorted({str(frame) for frame in columns.get("child_frame_id", ())})
    if frames[1:]:
        raise ValueError(
            f"it holds poses of {' and '.join(frames)}; keep those of one frame"
        )
    table = _of_arrays(columns, given, plural=False)
    if table is None:
        rows = [
            _cells({key: columns[key][i] for key in columns}) for i in range(len(rows))
        ]
        words = [*dict.fromkeys(word for row in rows for word in row)]
        require_at_most(len(words) * len(rows), "numbers", "values")
        cells = text_cells([str(row.get(word)) for word in words] for row in rows)
        table = _labelled(named_numbers(words, cells, given), columns, plural=False)
    return table._replace(
        fixed="quaternion_wxyz" in columns and "matrix" not in columns
    )


def _of_object(data: Columns, given: PoseConvention | None, robot: bool) -> PoseTable:
    stems = {re.sub(r"\d+", "", key) for key in data}
    numbered = len(stems) == 1 and not stems & data.keys()
    if data and (numbered or all(key.lower().endswith(IMAGE_ENDINGS) for key in data)):
        return pose_data([*data.values()], given, robot)._replace(names=tuple(data))
    kind = (
        data["parameters"]
        if isinstance(data.get("parameters"), Mapping) and robot
        else {}
    )
    fixed = (
        kind.get("calibration_type") == "eye_on_base"
        or kind.get("eye_on_hand") is False
    )
    if fixed and not (given and given.has("inverse")):
        problem = (
            "easy_handeye states gripper_from_base for a fixed camera (eye_to_hand)"
        )
        raise ConventionError(problem, "wxyz:inverse in place of --invert")
    columns = _of_role(data, given, robot)
    inner = [key for key in columns if key in _KEYS and len(_shape(columns[key])) < 2]
    if len(inner) == 1:
        return _labelled(
            pose_data(columns[inner[0]], given, robot), columns, plural=True
        )
    nested = any(_shape(value)[1:] for value in columns.values())
    table = _of_arrays(columns, given, plural=True) if nested else None
    if table is not None:
        return table
    if has_position([*_cells(_flat(columns))]):
        return pose_data([columns], given, robot)
    lists = [[*v.values()] if isinstance(v, Mapping) else v for v in columns.values()]
    if not has_position([*columns]) or not all(
        isinstance(each, list) for each in lists
    ):
        raise _unclear([], data)
    rows = [dict(zip(columns, row, strict=True)) for row in zip(*lists, strict=True)]
    return pose_data(rows, given, robot)


def _unclear(keys: list[str], data: Columns) -> ValueError:
    return ValueError(
        f"{' and '.join(keys) or 'none'} of its keys ({', '.join(data)}) may hold the poses;"
        f" call the right one 'poses'"
    )


def _of_role(columns: Columns, given: PoseConvention | None, robot: bool) -> Columns:
    """Columns of the robot or of the camera without that word, and of neither."""
    found = {key: match for key in columns if (match := _ROLES[robot].fullmatch(key))}
    own = {match[1] or match[2] or "pose": columns[key] for key, match in found.items()}
    inverse = [key for key in columns if _INVERSE.search(key)]
    if inverse and not own and not (given and given.has("inverse")):
        raise ConventionError(
            f"{inverse[0]} is the inverse of the pose", "such as matrix:inverse"
        )
    if len(own) < len(found):
        raise _unclear([*found], columns)
    others = {
        key: columns[key]
        for key in columns
        if not any(r.fullmatch(key) for r in _ROLES)
    }
    return others | own if own else columns


def _of_arrays(
    columns: Columns, given: PoseConvention | None, plural: bool
) -> PoseTable | None:
    """Poses of a key that holds arrays, or of keys for rotations and translations."""
    shapes = {key: _shape(value) for key, value in columns.items()}
    keys = [key for key in columns if key in _KEYS and len(shapes[key]) > 1]
    plain = {} if keys else {key: name_and_unit(key)[0] for key in columns}
    parts = [
        (first, second)
        for first, second in product(plain, plain)
        if len(shapes[first]) > 1 and len(shapes[second]) > (not plural)
        if (r := _ROTATION.fullmatch(plain[first]))
        if (t := _TRANSLATION.fullmatch(plain[second])) and r[1] == t[1]
    ]
    for key in plain:
        table = (
            len(shapes[key]) == 2
            and shapes[key][1] in _WIDTHS
            and "joint" not in key.lower()
        )
        matrices = shapes[key][-2:] in _MATRICES or shapes[key][:2] in _MATRICES
        keys += [key] if matrices or (table and plural) else []
    if len(keys) + len(parts) > 1:
        raise _unclear(keys + [f"{r} with {t}" for r, t in parts], columns)
    labels = {
        key: columns[key] for key in columns if key not in (*keys, *sum(parts, ()))
    }
    if parts:
        return _labelled(_composed(columns, *parts[0], given), labels, plural)
    return (
        _labelled(pose_data(columns[keys[0]], given), labels, plural) if keys else None
    )


def _composed(
    columns: Columns, rotation: str, translation: str, given: PoseConvention | None
) -> PoseTable:
    unit = name_and_unit(translation)[1] or "m"
    second = _rows(number_array(columns[translation], repr(translation)), 3)
    first = _first(number_array(columns[rotation], repr(rotation)), ((3, 3),))
    width = first.size // max(len(second), 1)
    kinds = {9: ("r", HEADERS["rotation matrix"].ends), 4: ("q", "1234")}
    prefix, ends = kinds.get(width, ("rotvec_" if "vec" in rotation else "r", "xyz"))
    words = [f"{axis}_{unit}" for axis in "xyz"] + [prefix + end for end in ends]
    numbers = np.concatenate([second, _rows(first, width)], -1)
    return named_numbers(
        words, text_cells([map(repr, row) for row in numbers.tolist()]), given
    )


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
    whole = np.abs(np.swapaxes(block, 1, 2) @ block - np.eye(3)).max() < 0.01
    return array if array.shape[1:] in shapes and whole else np.moveaxis(array, -1, 0)


def _labelled(table: PoseTable, columns: Columns, plural: bool) -> PoseTable:
    lists = {key: value for key, value in columns.items() if len(_shape(value)) == 1}
    names, stamps, _ = row_labels(
        [*lists], [*lists.values()], len(table.numbers), plural
    )
    stamps = stamps if table.stamps_s is None else table.stamps_s
    return table._replace(names=table.names or names, stamps_s=stamps)


def _plain(data: Any) -> Any:
    """Matrices of OpenCV and ViSP (rows, cols, data) as nested lists, and keys as text."""
    if isinstance(data, Mapping) and {"rows", "cols", "data"} <= data.keys():
        return (
            number_array(data["data"], "data")
            .reshape(data["rows"], data["cols"])
            .tolist()
        )
    if isinstance(data, Mapping):
        return {str(key): _plain(value) for key, value in data.items()}
    nested = isinstance(data, list) and any(isinstance(each, Mapping) for each in data)
    return [_plain(each) for each in data] if nested else data


def _flat(entry: Columns) -> dict[str, Any]:
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


def _cells(row: Columns) -> dict[str, object]:
    """One value a column: those of a list are columns of their own."""
    cells: dict[str, object] = {}
    for key, value in row.items():
        values = value if isinstance(value, list) else [value]
        require_at_most(len(values), "columns", "numbers of one key")
        names = [f"{key}_{i}" for i in range(len(values))] if values is value else [key]
        order = key[-4:].lower()  # such as quaternion_wxyz
        names = [f"q{axis}" for axis in order] if order in ("wxyz", "xyzw") else names
        cells |= dict(zip(_LISTS.get(key, names), values, strict=False))
    return cells


def _shape(value: object) -> tuple[int, ...]:
    """Lengths of nested lists, by the first of each: all are compared when numbers are read."""
    return (
        (len(value), *_shape(value[0] if value else None))
        if isinstance(value, list)
        else ()
    )
