"""The arm in the scene, by its URDF (extra `urdf`)."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import viser

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings.poses.kinematics import RobotModel


class Robot:
    """An arm whose base link is at the robot base, with a slider for each joint.

    Raises:
        InputError: The extra `urdf` is not installed, or the URDF or a mesh cannot be read.
    """

    def __init__(self, server: viser.ViserServer, path: Path, on_move: Callable[[], Any]):
        self._model, self._on_move = RobotModel(path), on_move  # reports what is wrong in the file
        from viser.extras import ViserUrdf

        server.scene.add_frame("/robot", show_axes=False)
        try:
            self._shown = ViserUrdf(server, path, root_node_name="/robot")
        except Exception as error:  # trimesh raises many types for broken meshes
            text = " ".join(f"{type(error).__name__}: {error}".split())[:200]
            raise InputError(f"{path}: cannot be drawn ({text}); check its meshes") from None
        self.joints: dict[str, viser.GuiSliderHandle[float]] = {}
        with server.gui.add_folder("Arm", expand_by_default=False):
            for name, (low, high) in self._shown.get_actuated_joint_limits().items():
                least, most = -np.pi if low is None else low, np.pi if high is None else high
                start = min(max(0.0, least), most)
                self.joints[name] = server.gui.add_slider(name, least, most, 0.01, start)
                self.joints[name].on_update(lambda _: self._move())
        self._shown.update_cfg(self._values())

    def base_from_link(self, link: str) -> SE3 | None:
        """Pose of a link at the joints of the sliders; None if there is none of this name."""
        if link not in self._model.links:
            return None
        return self._model.poses(tuple(self.joints), self._values()[None], None, link)[0][0]

    def _move(self) -> None:
        self._shown.update_cfg(self._values())
        self._on_move()

    def _values(self) -> np.ndarray:
        return np.array([slider.value for slider in self.joints.values()])
