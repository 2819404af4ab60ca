"""Layouts of tags as several tools write them: text and file ending."""

import json
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from evercal.calibration.boards.tags import square
from evercal.geometry import SE3

from .tagged import Places

Written = tuple[str, str]
HALF_TURN = SE3.exp([0, 0, 0, 0, 0, np.pi])
"""The AprilTag library's print against OpenCV's."""
OUT_OF_WALL = SE3.of(Rotation.from_matrix(np.eye(3)[[1, 2, 0]]), np.zeros(3))
"""WPILib's axes: x out of the tag, z up."""


def quaternion(pose: SE3) -> dict[str, float]:
    return dict(zip("wxyz", pose.rotation_wxyz.tolist(), strict=True))


def position(pose: SE3) -> dict[str, float]:
    return dict(zip("xyz", pose.translation_m.tolist(), strict=True))


def corners(places: Places) -> dict[int, np.ndarray]:
    return {number: pose.apply(square(side)) for number, (pose, side) in places.items()}


def apriltag_ros(places: Places) -> Written:
    rows = []
    for number, (pose, side) in places.items():
        own = pose @ HALF_TURN
        values = {"id": number, "size": side, **position(own)}
        values |= {f"q{axis}": value for axis, value in quaternion(own).items()}
        cells = ", ".join(f"{key}: {value:.9g}" for key, value in values.items())
        rows.append(f"          {{{cells}}}")
    lines = ["standalone_tags:", "  [", "    {id: 99, size: 0.1}", "  ]"]
    lines += ["tag_bundles:", "  [", "    {", "      name: 'plate',", "      layout:"]
    return "\n".join(
        [*lines, "        [", ",\n".join(rows), "        ]", "    }", "  ]"]
    ), "yaml"


def tagslam(places: Places) -> Written:
    lines = ["bodies:", " - plate:", "    default_tag_size: 0.02", "    tags:"]
    for number, (pose, side) in places.items():
        own = pose @ HALF_TURN
        vector = dict(zip("xyz", own.rotation.as_rotvec(), strict=True))
        lines += [f"    - id: {number}", f"      size: {side}", "      pose:"]
        for name, values in (("position", position(own)), ("rotation", vector)):
            cells = ", ".join(f"{key}: {value:.9f}" for key, value in values.items())
            lines.append(f"        {name}: {{{cells}}}")
    return "\n".join(lines), "yaml"


def marker_map(places: Places, per_metre: float = 1.0) -> Written:
    lines = ["%YAML:1.0", "---", "aruco_bc_dict: TAG36h11", "aruco_bc_nmarkers: 4"]
    lines += ["aruco_bc_mInfoType: 1", "aruco_bc_markers:"]
    for number, own in corners(places).items():
        points = ", ".join(
            "[ " + ", ".join(f"{value:.9e}" for value in point) + " ]"
            for point in per_metre * own
        )
        lines.append(f"   - {{ id:{number}, corners:[ {points} ] }}")
    return "\n".join(lines), "yml"


def marker_map_in_pixels(places: Places) -> Written:
    return marker_map(places, 8000)


def wpilib(places: Places) -> Written:
    tags = []
    for number, (pose, _) in places.items():
        own = pose @ OUT_OF_WALL
        turn = {key.upper(): value for key, value in quaternion(own).items()}
        stated = {"translation": position(own), "rotation": {"quaternion": turn}}
        tags.append({"ID": number, "pose": stated})
    field = {"length": 16.5, "width": 8.2}
    return json.dumps({"tags": tags, "field": field}), "json"


def limelight(places: Places) -> Written:
    tags = []
    for number, (pose, side) in places.items():
        tag = {"family": "apriltag3_36h11_classic", "id": number, "unique": True}
        tag["transform"] = pose.matrix().ravel().tolist()
        tags.append(tag | {"size": 1000 * side})
    return json.dumps({"type": "frc", "fiducials": tags}), "json"


def table(header: str, rows: list, separator: str = ",") -> Written:
    lines = [header] if header else []
    for number, *values in rows:
        cells = [str(number), *(f"{value:.9g}" for value in values)]
        lines.append(separator.join(cells))
    return "\n".join(lines), "csv"


def corner_table(places: Places) -> Written:
    names = ",".join(f"{axis}{k}" for k in range(4) for axis in "xyz")
    rows = [[number, *own.ravel()] for number, own in corners(places).items()]
    return table(f"id,{names}", rows)


def corners_backwards_in_millimetres(places: Places) -> Written:
    rows = [
        [number, *(1000 * own[::-1]).ravel()] for number, own in corners(places).items()
    ]
    return table("", rows, " ")


def quaternion_table(places: Places) -> Written:
    rows = []
    for number, (pose, side) in places.items():
        w, *vector = pose.rotation_wxyz
        rows.append([number, *pose.translation_m, *vector, w, side])
    return table("id,x,y,z,qx,qy,qz,qw,size", rows)


def quaternion_table_without_header(places: Places) -> Written:
    rows = [
        [number, *pose.translation_m, *pose.rotation_wxyz, side]
        for number, (pose, side) in places.items()
    ]
    return table("", rows)


def degrees_and_millimetres(places: Places) -> Written:
    rows = []
    for number, (pose, side) in places.items():
        angles = pose.rotation.as_euler("xyz", degrees=True)
        rows.append([number, *(1000 * pose.translation_m), *angles, 1000 * side])
    return table("tag_id;x_mm;y_mm;z_mm;roll;pitch;yaw;size_mm", rows, ";")


def corners_by_key(places: Places) -> Written:
    tags = {
        str(number): {"corners": own.tolist()}
        for number, own in corners(places).items()
    }
    return json.dumps({"tags": tags}), "json"


def bare_corners_by_key(places: Places) -> Written:
    return json.dumps(
        {number: own.tolist() for number, own in corners(places).items()}
    ), "json"


def corners_as_objects(places: Places) -> Written:
    tags = [
        {
            "id": number,
            "corners": [dict(zip("xyz", point, strict=True)) for point in own],
        }
        for number, own in corners(places).items()
    ]
    return json.dumps(tags), "json"


def scalar_last_by_name(places: Places) -> Written:
    tags = {}
    for number, (pose, side) in places.items():
        w, *vector = pose.rotation_wxyz.tolist()
        stated = {"position": pose.translation_m.tolist(), "quaternion": [*vector, w]}
        tags[f"tag_{number}"] = stated | {"size": side}
    return json.dumps(tags), "json"


def matrices(places: Places) -> Written:
    tags = [
        {"tag_id": number, "tag_size": side, "T": pose.matrix().tolist()}
        for number, (pose, side) in places.items()
    ]
    return json.dumps(tags), "json"


def vectors(places: Places) -> Written:
    tags = []
    for number, (pose, side) in places.items():
        tag = {"marker_id": number, "length": side, "tvec": pose.translation_m.tolist()}
        tags.append(tag | {"rvec": pose.rotation.as_rotvec().tolist()})
    return json.dumps({"markers": tags}), "json"


def ros_poses(places: Places) -> Written:
    tags = []
    for number, (pose, side) in places.items():
        stated = {"position": position(pose), "orientation": quaternion(pose)}
        tags.append({"index": number, "marker_size": side, "pose": stated})
    return json.dumps({"frame_id": "plate", "markers": tags}), "yaml"


SIZED: list[Callable[[Places], Written]] = [
    apriltag_ros,
    tagslam,
    marker_map,
    marker_map_in_pixels,
    limelight,
    corner_table,
    corners_backwards_in_millimetres,
    quaternion_table,
    quaternion_table_without_header,
    degrees_and_millimetres,
    corners_by_key,
    bare_corners_by_key,
    corners_as_objects,
    scalar_last_by_name,
    matrices,
    vectors,
    ros_poses,
]
UNSIZED = [wpilib]
"""They state no sides."""
