"""The arm in the scene, by its URDF (extra `urdf`)."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import viser

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.poses.kinematics import RobotModel


class Robot:
    """An arm whose base link is at the robot base.

    Args:
        server: The page.
        path: The URDF; meshes are searched beside it.

    Raises:
        InputError: The extra `urdf` is not installed, the file is missing or no URDF, or a mesh
            cannot be read.
    """

    def __init__(self, server: viser.ViserServer, path: Path):
        model = RobotModel(path)  # reports what is wrong with the file
        import yourdfpy  # pyright: ignore[reportMissingImports]
        from viser.extras import ViserUrdf

        self.path, self.links = path, model.links
        handler = partial(yourdfpy.filename_handler_magic, dir=path.parent)
        try:
            self._urdf: Any = yourdfpy.URDF.load(str(path), filename_handler=handler)
            server.scene.add_frame("/robot", show_axes=False)
            self._shown = ViserUrdf(server, self._urdf, root_node_name="/robot")
        except Exception as error:  # trimesh raises many types for broken meshes
            text = " ".join(str(error).split())[:200]
            raise InputError(
                f"{path}: cannot be drawn ({type(error).__name__}: {text}); check its meshes"
            ) from None
        self.joints: tuple[str, ...] = tuple(self._urdf.actuated_joint_names)
        self.move(None)

    def move(self, joints_rad: Sequence[float] | None) -> None:
        """Put the arm at joint values, in the order of the URDF.

        Joints without a value, such as fingers, and all joints for None, are at 0.

        Raises:
            InputError: More values than joints.
        """
        values = np.zeros(len(self.joints))
        given = () if joints_rad is None else joints_rad
        if len(given) > len(values):
            raise InputError(
                f"{self.path}: has {len(values)} joints, the recording states {len(given)}"
            )
        values[: len(given)] = given
        self._shown.update_cfg(values)

    def base_from_link(self, link: str) -> SE3 | None:
        """Pose of a link at the current joints; None if there is none of this name."""
        if link not in self.links:
            return None
        return SE3.from_matrix(self._urdf.get_transform(link, self._urdf.base_link))
