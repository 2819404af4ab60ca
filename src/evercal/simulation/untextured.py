"""Untextured renderings of a simulated room, for comparison with images of it."""

import numpy as np

from evercal.errors import InputError
from evercal.geometry import SE3
from evercal.recordings import Frame
from evercal.simulation.furnished.materials import plain
from evercal.simulation.furnished.panda import HOME_RAD, Panda
from evercal.simulation.furnished.renderer import Renderer, RenderOptions
from evercal.simulation.furnished.rooms import room


def untextured_renders(
    model: tuple[str, int], frames: list[Frame], poses: list[SE3]
) -> list[np.ndarray]:
    """Render a room and its robot in one colour.

    The model is the kind and seed of the room; poses are base_from_camera. Returns images (H, W, 3)
    uint8; an empty list if the extra `sim` is not installed.
    """
    try:
        panda = Panda()
        grey = plain("grey", (0.7, 0.7, 0.7))
        arms = [panda.meshes(np.array(f.joints_rad or HOME_RAD)) for f in frames]
        bare = [(mesh, m if m.emission else grey) for mesh, m in room(*model).meshes()]
        renderer = Renderer(bare + [(mesh, grey) for mesh, _ in arms[0]])
    except InputError:
        return []
    images = []
    for i, (frame, arm, pose) in enumerate(zip(frames, arms, poses, strict=True)):
        renderer.move({mesh.name: mesh for mesh, _ in arm})
        images.append(renderer.render(frame.camera, pose, RenderOptions(8), i))
    return images
