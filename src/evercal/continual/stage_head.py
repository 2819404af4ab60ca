"""The head that a stage trains: a new one, the last one grown by a scene, or a copy of it."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from evercal.continual.networks.atlas import camera_clusters
from evercal.continual.networks.buffer import FeatureBuffer
from evercal.continual.networks.head import Head
from evercal.continual.stage import StageOptions
from evercal.mapping.scene_maps import SceneMaps

WHITENING_ROWS = 20_000


def head_for_scene(
    maps: SceneMaps, own: bool, options: StageOptions, positions_m: np.ndarray
) -> tuple[Head, int]:
    """The head to train, which is put in its place among those of `maps`.

    Args:
        maps: with the heads of earlier scenes; changed.
        own: whether every scene has a head of its own; it starts from the last one's weights.
        options: of the stage.
        positions_m: (n, 3) camera positions of the scene in the atlas.

    Returns:
        The head, grown by this scene, and the scene's index in it.
    """
    if not maps.heads:
        head = fresh_head(maps, options)
    elif own:
        head = maps.heads[-1].without_scenes()
    else:
        head = maps.heads.pop()
    local = head.scenes
    head.grow(_new_centres(head, options, positions_m), options.seed + len(maps.scenes))
    maps.heads.append(head)
    return head, local


def head_for_all(maps: SceneMaps, options: StageOptions, positions_m: Sequence[np.ndarray]) -> Head:
    """A new head with room for several scenes, from the camera positions of each in the atlas."""
    head = fresh_head(maps, options)
    for number, places in enumerate(positions_m):
        head.grow(_new_centres(head, options, places), options.seed + number)
    maps.heads = [head]
    return head


def fresh_head(maps: SceneMaps, options: StageOptions) -> Head:
    """A head that knows no scene."""
    torch.manual_seed(options.seed)
    return Head(maps.encoder.width, maps.descriptor.width, options.head).to(maps.device)


def whiten(head: Head, buffers: Sequence[FeatureBuffer], seed: int) -> None:
    """Fits the whitening of a new head's inputs to rows of all buffers, where it has any."""
    if not head.options.whiten:
        return
    generator = torch.Generator().manual_seed(seed)
    drawn = [buffer.draw(WHITENING_ROWS // len(buffers), generator) for buffer in buffers]
    head.whiten(torch.cat([rows.features for rows in drawn]))


def _new_centres(head: Head, options: StageOptions, positions_m: np.ndarray) -> Tensor:
    """(k, 3) centres that the scene adds, from its camera positions (n, 3) in the atlas."""
    if head.options.centres == "grow":
        count = head.options.centres_per_scene
        return torch.from_numpy(camera_clusters(positions_m, count, options.seed)).float()
    if len(head.centres):
        return torch.zeros(0, 3)
    return torch.tensor(options.fixed_centres_m).reshape(-1, 3)
