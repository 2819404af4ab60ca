"""Forward kinematics of an arm from its URDF, by yourdfpy (extra `urdf`)."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evercal.errors import InputError, missing_extra
from evercal.geometry import SE3

_MOVING = ("revolute", "continuous", "prismatic")
# Two full rotations: no joint of an arm exceeds them, and 12.6 in degrees is a small angle.
_LARGEST_RAD = 4 * np.pi


class RobotModel:
    """Links and joints of a URDF; its meshes are not read."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        try:
            import yourdfpy  # pyright: ignore[reportMissingImports]
        except ImportError:
            raise missing_extra(f"{path}: reading a URDF needs yourdfpy", "urdf") from None
        if not self.path.is_file():
            raise InputError(f"{path}: no such URDF file")
        if self.path.suffix == ".xacro":
            raise InputError(f"{path}: is a macro file; make a URDF of it with 'xacro' first")
        try:
            self._urdf: Any = yourdfpy.URDF.load(
                str(self.path),
                load_meshes=False,
                load_collision_meshes=False,
                build_collision_scene_graph=False,
            )
            self.base_link = str(self._urdf.base_link)
        except Exception as error:  # lxml, yourdfpy and numpy raise many types for broken files
            text = " ".join(str(error).split())[:200]
            raise InputError(f"{path}: no usable URDF ({type(error).__name__}: {text})") from None
        self.links = tuple(self._urdf.link_map)
        self._joint_above = {joint.child: joint for joint in self._urdf.robot.joints}

    def has_joint(self, name: str) -> bool:
        """Whether the URDF has a joint of this name."""
        return name in self._urdf.joint_map

    def chosen_links(self, base: str | None, gripper: str | None) -> tuple[str, str]:
        """Base and gripper link; if omitted, the root and the only end of the arm."""
        parents = {joint.parent for joint in self._joint_above.values()}
        ends = [link for link in self.links if link not in parents]
        if gripper is None and len(ends) != 1:
            raise InputError(
                f"{self.path}: has {len(ends)} ends; name the link with --gripper-frame, one of"
                f" {', '.join(self.links)}"
            )
        return base or self.base_link, gripper or ends[0]

    def poses(
        self,
        names: Sequence[str],
        values: NDArray[np.float64],
        base: str | None,
        gripper: str | None,
    ) -> tuple[SE3, list[str]]:
        """Compute (n,) poses of the gripper, with notes about their source and joint limits."""
        base, gripper = self.chosen_links(base, gripper)
        poses = self.base_from_gripper(names, values, base, gripper)
        note = f"gripper poses are those of {gripper} in {base}, from {self.path.name}"
        needed = self.joints_between(base, gripper)
        columns = values[:, [list(names).index(name) for name in needed]]
        return poses, [note, *self.beyond_limits(needed, columns)]

    def joints_between(self, base: str, gripper: str) -> tuple[str, ...]:
        """Moving joints between two links, from the base outwards."""
        up, down = self._ancestors(base), self._ancestors(gripper)
        joints = [j for j in down if j not in up] + [j for j in up if j not in down]
        names = []
        for joint in reversed(joints):
            if joint.type in ("floating", "planar"):
                raise InputError(f"{self.path}: joint {joint.name} is {joint.type}; not supported")
            if joint.type in _MOVING:
                names.append(joint.name if joint.mimic is None else joint.mimic.joint)
        return tuple(dict.fromkeys(names))

    def base_from_gripper(
        self, names: Sequence[str], values: NDArray[np.float64], base: str, gripper: str
    ) -> SE3:
        """Compute (n,) poses of the link `gripper` in the link `base`.

        Values (n, k) of the k named joints are radians, or metres for prismatic joints.
        """
        needed = self.joints_between(base, gripper)
        missing = [name for name in needed if name not in names]
        if missing:
            raise InputError(
                f"no values for joint {', '.join(missing)}, which {gripper} depends on; given are"
                f" {', '.join(names) or 'none'}"
            )
        values = values[:, [list(names).index(name) for name in needed]]
        for name, column in zip(needed, values.T, strict=True):
            revolute = self._urdf.joint_map[name].type == "revolute"
            if revolute and column.size and np.abs(column).max() > _LARGEST_RAD:
                raise InputError(
                    f"joint {name} is at {column[np.abs(column).argmax()]:.1f}, too far for"
                    f" radians; if these are degrees, write the column as {name}_deg"
                )
        matrices = np.empty((len(values), 4, 4))
        for row, matrix in zip(values, matrices, strict=True):
            self._urdf.update_cfg(dict(zip(needed, row.tolist(), strict=True)))
            matrix[...] = self._urdf.get_transform(gripper, base)
        return SE3.from_matrix(matrices)

    def rotates(self, name: str) -> bool:
        """Whether a joint exists and its values are angles."""
        joint = self._urdf.joint_map.get(name)
        return joint is not None and joint.type in ("revolute", "continuous")

    def beyond_limits(self, names: Sequence[str], values: NDArray[np.float64]) -> list[str]:
        """One sentence for each joint that exceeds its limits by more than 0.1.

        Joints without limits are reported beyond two full rotations, which degrees exceed, too.
        """
        notes = []
        for name, column in zip(names, values.T, strict=True):
            joint = self._urdf.joint_map.get(name)
            limit = None if joint is None else joint.limit
            covered = f"joint {name} goes from {column.min():.2f} to {column.max():.2f}"
            if joint is not None and joint.type == "continuous":
                if np.ptp(column) > _LARGEST_RAD:
                    notes.append(
                        f"{covered}, more than two rotations in radians; are these degrees?"
                    )
            elif limit is None or limit.lower is None or limit.upper is None:
                continue
            elif column.min() < limit.lower - 0.1 or column.max() > limit.upper + 0.1:
                notes.append(
                    f"{covered}, the URDF allows {limit.lower:.2f} to {limit.upper:.2f}; are the"
                    f" joints in the right order and in radians?"
                )
        return notes

    def _ancestors(self, link: str) -> list[Any]:
        if link not in self.links:
            raise InputError(
                f"{self.path}: has no link {link!r}; its links are {', '.join(self.links)}"
            )
        joints = []
        while link in self._joint_above:
            joints.append(self._joint_above[link])
            link = joints[-1].parent
        return joints
