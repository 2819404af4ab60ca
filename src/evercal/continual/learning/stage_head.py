"""The head of a stage: a new one, the last one grown by a scene, or a copy of it."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from evercal.continual.learning.stage import StageOptions
from evercal.continual.networks.atlas import camera_clusters
from evercal.continual.networks.buffer import FeatureBuffer
from evercal.continual.networks.head import Head, fresh_head
from evercal.continual.scenes import LearnedScenes

WHITENING_ROWS = 20_000


def head_for_scene(
    scenes: LearnedScenes, own: bool, options: StageOptions, positions_m: np.ndarray
) -> tuple[Head, int]:
    """The head to train, added to those of `scenes`.

    Args:
        scenes: with the heads of earlier scenes; changed.
        own: whether every scene has a head of its own; it starts from the last one's weights.
        options: of the stage.
        positions_m: (n, 3) camera positions of the scene in the atlas.

    Returns:
        The head, grown by this scene, and the scene's index in it.
    """
    if not scenes.heads:
        head = _head_without_scenes(scenes, options)
    elif own:
        head = scenes.heads[-1].without_scenes()
    else:
        head = scenes.heads.pop()
    local = head.scenes
    head.grow(_new_centres(head, options, positions_m), options.seed + len(scenes.scenes))
    scenes.heads.append(head)
    return head, local


def head_for_all(
    scenes: LearnedScenes, options: StageOptions, positions_m: Sequence[np.ndarray]
) -> Head:
    """A new head with room for several scenes, from the camera positions of each in the atlas."""
    head = _head_without_scenes(scenes, options)
    for number, positions in enumerate(positions_m):
        head.grow(_new_centres(head, options, positions), options.seed + number)
    scenes.heads = [head]
    return head


def _head_without_scenes(scenes: LearnedScenes, options: StageOptions) -> Head:
    widths = scenes.encoder.width, scenes.descriptor.width
    return fresh_head(*widths, options.head, options.seed).to(scenes.device)


def whiten(head: Head, buffers: Sequence[FeatureBuffer], seed: int) -> None:
    """Fit the whitening of a new head's inputs to rows of all buffers, if it has one."""
    if not head.options.whiten:
        return
    generator = torch.Generator().manual_seed(seed)
    drawn = [buffer.draw(WHITENING_ROWS // len(buffers), generator) for buffer in buffers]
    head.whiten(torch.cat([rows.features for rows in drawn]))


def _new_centres(head: Head, options: StageOptions, positions_m: np.ndarray) -> Tensor:
    if head.options.centres == "grow":
        count = head.options.centres_per_scene
        return torch.from_numpy(camera_clusters(positions_m, count, options.seed)).float()
    if len(head.centres):
        return torch.zeros(0, 3)
    return torch.tensor(options.fixed_centres_m).reshape(-1, 3)
