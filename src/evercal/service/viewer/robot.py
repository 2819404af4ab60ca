"""The arm in the scene, by its URDF (extra `urdf`)."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import viser

from evercal.errors import InputError
from evercal.recordings.poses.kinematics import RobotModel
from evercal.service.viewer.drawing import place


def add_arm(
    server: viser.ViserServer, path: Path, gripper: viser.FrameHandle, links: Sequence[str]
) -> list[viser.GuiSliderHandle[float]]:
    """Add an arm at the robot base, and a slider for each joint, which are returned.

    `gripper` is a node that moves with the first of `links` that the arm has.
    """
    model = RobotModel(path)  # reports what is wrong in the file
    from viser.extras import ViserUrdf

    link = next((link for link in links if link in model.links), None)
    server.scene.add_frame("/robot", show_axes=False)
    try:
        shown = ViserUrdf(server, path, root_node_name="/robot")
    except Exception as error:  # trimesh raises many types for broken meshes
        text = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise InputError(f"{path}: cannot be drawn ({text}); check its meshes") from None
    limits, sliders = shown.get_actuated_joint_limits(), []

    def move() -> None:
        values = np.array([slider.value for slider in sliders])
        shown.update_cfg(values)
        if link is not None:
            place(gripper, model.poses(tuple(limits), values[None], None, link)[0][0])

    with server.gui.add_folder("Arm", expand_by_default=False):
        for name, (low, high) in limits.items():
            least, most = -np.pi if low is None else low, np.pi if high is None else high
            start = min(max(0.0, least), most)
            sliders.append(server.gui.add_slider(name, least, most, 0.01, start))
            sliders[-1].on_update(lambda _: move())
    move()
    return sliders
