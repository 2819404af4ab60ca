"""Poses in nested lists and objects, as JSON, YAML, NPZ and MATLAB files hold them.

Poses are lists of numbers, matrices, objects with named numbers, or rotations and translations
under two keys. They are in a list, under the names of images, or under a key. The order of keys
does not matter.
"""

import re
from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any

from evercal.bounds import require_at_most
from evercal.recordings.images import IMAGE_ENDINGS
from evercal.recordings.poses.conventions import (
    ConventionError,
    Given,
    pose_convention,
)
from evercal.recordings.poses.messages import DETECTIONS, entries_of_messages
from evercal.recordings.poses.plain_rows import plain_numbers
from evercal.recordings.poses.pose_arrays import (
    MATRICES,
    Columns,
    are_poses,
    composed_poses,
    nested_shape,
    poses_first,
    rotations_with_translations,
)
from evercal.recordings.poses.pose_columns import (
    PoseTable,
    has_position,
    named_numbers,
)
from evercal.recordings.poses.row_files import (
    number_array,
    row_labels,
    text_cells,
)
from evercal.robot.frame_names import FrameNames
from evercal.storage.text_files import natural_key
from evercal.typing import JsonObject

_KEYS = (
    "poses",
    "T",
    "transforms",
    "matrices",
    "samples",
    "pose",
    "matrix",
)
"""Keys of poses of anything."""
_CAMERA = (
    "camera_from_board|camera_poses?|tracking|optical|board|marker|target2cam|object_wrt_sensor"
    "|camera_marker_samples"
)
"""Keys of the camera; among others OpenCV's, MoveIt's and easy_handeye's."""
_ROBOT = (
    "base_from_gripper|robot_poses?|robot|tcp_poses?|gripper|end_effector|gripper2base"
    "|effector_wrt_world|hand_world_samples"
)
"""Keys of the robot."""
_ROLES = {
    True: re.compile(rf"(?:{_ROBOT})(?:_(.+))?|(.+)_(?:{_ROBOT})"),
    False: re.compile(rf"(?:{_CAMERA})(?:_(.+))?|(.+)_(?:{_CAMERA})"),
}
"""Keys of the robot or of the camera, with the rest of the key after or before."""
_ON_ARM = "gripper|hand|eef?|tool0?|tcp|flange|end_effector|effector|wrist|tip"
_BASE = "base|base_link|world|robot"
_BOARD = "board|target|marker|tag|object|pattern"
_SENSOR = "cam|camera|sensor|optical"
_INVERSES = {
    True: ((f"{_ON_ARM}|{_SENSOR}", _BASE), (_BOARD, _SENSOR)),
    False: ((_ON_ARM, _BASE), (f"{_BOARD}|world", _SENSOR)),
}
"""Words of what moves and of what its pose is stated in, of the robot or of the camera."""
_LISTS = {
    "translation_m": ("x_m", "y_m", "z_m"),
    "xyz": ("x", "y", "z"),
    "rpy": ("roll", "pitch", "yaw"),
}
"""Columns of lists by key."""
_QUATERNIONS = {
    "wxyz": ("qw", "qx", "qy", "qz"),
    "xyzw": ("qx", "qy", "qz", "qw"),
}
"""Columns of lists by the end of the key, such as quaternion_wxyz."""
_STAMPS = (
    ("nanosec", "sec"),
    ("nsecs", "secs"),
    ("nsec", "sec"),
    ("nanoseconds", "seconds"),
)
"""Keys of a stamp in nanoseconds and seconds: of ROS 2, of ROS 1, and of others."""


def pose_data(data: Any, given: Given, robot: bool = True) -> PoseTable:
    """Poses of the robot, or else of the camera, in a convention or the one that keys define.

    ValueError: these are no poses, or it is not clear which ones.
    """
    data = _plain(data)
    if isinstance(data, Mapping) and not DETECTIONS.isdisjoint(data):
        data = [data]
    if isinstance(data, Mapping):
        return _of_object(data, given, robot)
    kinds = set()
    if isinstance(data, list):
        kinds = {*map(_is_object, data)}
    if len(kinds) != 1:
        raise ValueError(
            "poses are a list of objects, or of lists of numbers, not of both"
        )
    if True in kinds:
        return _of_objects(data, given, robot)
    array = number_array(data, "a list of poses")
    numbers = poses_first(array, MATRICES)
    if numbers.shape[-2:] == (6, 1):  # ViSP's vectors of poses
        numbers = numbers.reshape(-1, 6)
        given = given or pose_convention("ur")
    if numbers.ndim == 1 or numbers.shape in MATRICES:
        numbers = numbers[None]
    return plain_numbers(numbers, given)


def _of_objects(entries: list[Any], given: Given, robot: bool) -> PoseTable:
    """Poses of a list of one object for each."""
    rows = [*map(_flat, entries_of_messages(entries, given))]
    keys = dict.fromkeys(chain.from_iterable(rows))
    require_at_most(len(keys), "columns", "keys")
    require_at_most(len(keys) * len(rows), "numbers", "values")
    columns = {key: [row.get(key) for row in rows] for key in keys}
    columns = _of_role(columns, given, robot)
    frames = [_frame_of(columns, key) for key in ("header_frame_id", "child_frame_id")]
    table = _of_arrays(columns, given, plural=False)
    if not table:
        table = _of_cells(columns, given)
    fixed = "quaternion_wxyz" in columns and "matrix" not in columns
    return table._replace(fixed=fixed, frames=FrameNames(*frames))


def _frame_of(columns: Columns, key: str) -> str:
    """The frame that all messages name, without the leading slash of old ROS 1 programs."""
    frames = sorted({*map(str, columns.get(key, ()))})
    if len(frames) > 1:
        raise ValueError(
            f"it holds poses of {' and '.join(frames)}; keep those of one frame"
        )
    return "".join(frames).lstrip("/")


def _of_cells(columns: Columns, given: Given) -> PoseTable:
    """Poses whose numbers have a key each, or lists of some of them."""
    rows = [*map(_cells, _rows_of(columns))]
    words = [*dict.fromkeys(chain.from_iterable(rows))]
    require_at_most(len(words) * len(rows), "numbers", "values")
    cells = []
    for row in rows:
        cells.append([str(row.get(word)) for word in words])
    table = named_numbers(words, text_cells(cells), given)
    return _labelled(table, columns, plural=False)


def _of_object(data: Columns, given: Given, robot: bool) -> PoseTable:
    """Poses of an object: by image or number, under one key, or with their numbers under keys."""
    names = _keys_of_images(data)
    if names:
        poses = [data[name] for name in names]
        table = pose_data(poses, given, robot)
        return table._replace(names=tuple(names))
    if robot:
        _refuse_eye_on_base(data, given)
    columns = _of_role(data, given, robot)
    inner = []
    has_arrays = False
    for key, value in columns.items():
        is_array = len(nested_shape(value)) > 1
        has_arrays |= is_array
        if key in _KEYS and not is_array:
            inner.append(key)
    if len(inner) == 1:
        table = pose_data(columns[inner[0]], given, robot)
        return _labelled(table, columns, plural=True)
    if has_arrays:
        table = _of_arrays(columns, given, plural=True)
        if table:
            return table
    if has_position([*_cells(_flat(columns))]):
        return pose_data([columns], given, robot)
    lists = {}
    for key, value in columns.items():
        if isinstance(value, Mapping):
            value = [value[number] for number in sorted(value, key=natural_key)]
        lists[key] = value
    if {*map(type, lists.values())} != {list} or not has_position([*columns]):
        raise _unclear([], data)
    return pose_data(_rows_of(lists), given, robot)


def _rows_of(columns: Columns) -> list[JsonObject]:
    """An object for each pose, of the lists of its keys."""
    poses = zip(*columns.values(), strict=True)
    return [dict(zip(columns, values, strict=True)) for values in poses]


def _keys_of_images(data: Columns) -> list[str]:
    """Keys that are names of images, or one word with numbers; else none."""
    if all(key.lower().endswith(IMAGE_ENDINGS) for key in data):
        return [*data]
    words = {re.sub(r"\d+", "", key) for key in data}
    is_numbered = len(words) == 1 and words.isdisjoint(data)
    # The number of gripper2base counts nothing: it holds a list of matrices.
    many = max(map(len, map(nested_shape, data.values())), default=0) > 2
    if is_numbered and not many:
        return sorted(data, key=natural_key)
    return []


def _refuse_eye_on_base(data: Columns, given: Given) -> None:
    parameters = data.get("parameters")
    if not isinstance(parameters, Mapping):
        return
    if given and given.has("inverse"):
        return
    on_base = parameters.get("calibration_type") == "eye_on_base"
    if on_base or parameters.get("eye_on_hand") is False:
        problem = (
            "easy_handeye states gripper_from_base for a fixed camera (eye_to_hand)"
        )
        raise ConventionError(problem, "wxyz:inverse in place of `invert`")


def _unclear(keys: Sequence[str], data: Columns) -> ValueError:
    return ValueError(
        f"{' and '.join(keys) or 'none'} of its keys ({', '.join(data)}) may hold the poses;"
        f" call the right one 'poses'"
    )


def _of_role(columns: Columns, given: Given, robot: bool) -> Columns:
    """Columns of the robot or of the camera without that word, and of neither."""
    keys = []
    of_role: JsonObject = {}
    others: JsonObject = {}
    inverse = [key for key in columns if _is_inverse(key, robot)]
    for key, value in columns.items():
        match = _ROLES[robot].fullmatch(key)
        if match and key not in inverse:
            keys.append(key)
            of_role[match[1] or match[2] or "pose"] = value
        elif not _ROLES[not robot].fullmatch(key):
            others[key] = value
    if keys:
        if len(of_role) < len(keys):
            raise _unclear(keys, columns)
        return others | of_role
    if inverse and not (given and given.has("inverse")):
        right = "base_from_gripper" if robot else "camera_from_board"
        raise ConventionError(
            f"{inverse[0]} is the inverse of the pose by its name; call it {right} if it is not",
            "such as matrix:inverse",
        )
    return columns


def _is_inverse(key: str, robot: bool) -> bool:
    """Whether a key names the inverse: poses of the base in the frame that moves."""
    for moved, fixed in _INVERSES[robot]:
        forms = [
            rf"(?<![a-z])({moved})_from_({fixed})",
            rf"(?<![a-z])({fixed})(2|_2_|_to_|_in_)({moved})",
            rf"(?<![a-z])({moved})_?T_?({fixed})",
            rf"(?<![a-z])[THX]_({moved})_({fixed})",
        ]
        if re.search(rf"({'|'.join(forms)})(?![a-z])", key, re.IGNORECASE):
            return True
    # Letters, as in T_e_b.
    return re.fullmatch("[THX]_[eghf]_[bw]|[eghf]_?T_?[bw]", key) is not None


def _of_arrays(columns: Columns, given: Given, plural: bool) -> PoseTable | None:
    """Poses of a key that holds arrays, or of keys for rotations and translations."""
    shapes = {}
    keys = []
    for key, value in columns.items():
        shapes[key] = nested_shape(value)
        if key in _KEYS and len(shapes[key]) > 1:
            keys.append(key)
    pairs = []
    if not keys:
        keys = [key for key in columns if are_poses(key, shapes[key], plural)]
        pairs = rotations_with_translations(shapes, plural)
    if len(keys) + len(pairs) > 1:
        raise _unclear([*keys, *map(" with ".join, pairs)], columns)
    labels = dict(columns)
    for key in chain(keys, *pairs):
        del labels[key]
    if pairs:
        rotation, translation = pairs[0]
        table = composed_poses(columns, rotation, translation, given)
    elif keys:
        table = pose_data(columns[keys[0]], given)
    else:
        return None
    return _labelled(table, labels, plural)


def _labelled(table: PoseTable, columns: Columns, plural: bool) -> PoseTable:
    """A table with the image names and stamps of the columns that hold one value a pose."""
    lists = {}
    for key, value in columns.items():
        if len(nested_shape(value)) == 1:
            lists[key] = value
    count = len(table.numbers)
    names, stamps, _ = row_labels([*lists], [*lists.values()], count, plural)
    if table.stamps_s is not None:
        stamps = table.stamps_s
    return table._replace(names=table.names or names, stamps_s=stamps)


def _plain(data: Any) -> Any:
    """Matrices of OpenCV and ViSP (rows, cols, data) as nested lists, and keys as text."""
    if isinstance(data, list):
        if any(map(_is_object, data)):
            return [*map(_plain, data)]
        return data
    if not _is_object(data):
        return data
    if {"rows", "cols", "data"} <= data.keys():
        numbers = number_array(data["data"], "data")
        matrix = numbers.reshape(data["rows"], data["cols"])
        return matrix.tolist()
    return {str(key): _plain(value) for key, value in data.items()}


def _is_object(value: object) -> bool:
    return isinstance(value, Mapping)


def _flat(entry: Columns) -> JsonObject:
    """Values of nested objects; the stamp of a ROS message as seconds."""
    cells: JsonObject = {}
    for key, value in entry.items():
        require_at_most(len(key), "name_characters", "characters of a key")
        if not isinstance(value, Mapping):
            cells[key] = value
        elif key == "stamp" and tuple(sorted(value)) in _STAMPS:
            nanoseconds, seconds = sorted(value)
            cells["stamp_s"] = value[seconds] + 1e-9 * value[nanoseconds]
        else:
            for inner, number in _flat(value).items():
                cells[f"{key}_{inner}"] = number
    return cells


def _cells(row: Columns) -> JsonObject:
    """One value a column: those of a list are columns of their own."""
    cells: JsonObject = {}
    for key, value in row.items():
        order = key[-4:].lower()
        names = _LISTS.get(key) or _QUATERNIONS.get(order)
        values = value
        if not isinstance(value, list):
            values = [value]
            names = names or [key]
        require_at_most(len(values), "columns", "numbers of one key")
        names = names or [f"{key}_{i}" for i in range(len(values))]
        cells |= dict(zip(names, values, strict=False))
    return cells
