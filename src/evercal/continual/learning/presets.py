"""Presets of the training effort per scene."""

from collections.abc import Callable, Iterable
from dataclasses import replace

from evercal.continual.learning.stage import StageOptions
from evercal.continual.networks.buffer import EncodePlan
from evercal.continual.networks.head import HeadOptions
from evercal.continual.networks.loss import LossOptions
from evercal.continual.networks.trainer import FitOptions
from evercal.recordings import Frame


def _ours(
    width: int, steps: int, rows: int, views: int, replay_views: int = 4
) -> StageOptions:
    """Our network; `rows` are new in a step, and half as many are replayed."""
    return StageOptions(
        head=HeadOptions(width),
        fit=FitOptions(steps, rows, rows // 2, surface_weight=2.0),
        encode=EncodePlan(views),
        replay_views_per_frame=replay_views,
    )


PRESETS: dict[str, StageOptions] = {
    # At most 240 s per scene on two cores.
    "fast": _ours(width=384, steps=2400, rows=2048, views=4),
    # At most 45 s per scene of about 100 frames.
    "demo": _ours(width=256, steps=1000, rows=2048, views=3),
    # For quick trials: 600 steps are too few to converge, see `converged`.
    "bench": _ours(width=256, steps=600, rows=512, views=1, replay_views=2),
    # Chosen on held-out frames of `sim-tune`; joint training still gains from more steps
    # (research/protocol.md).
    "converged": _ours(width=256, steps=1200, rows=1536, views=4),
    # The paper's settings, for a GPU: AdamW at 0.005 and 15,000 steps per scene. The rows of a step
    # and of the buffer are GLACE's. The paper does not state the number of replayed rows; here it
    # is the same.
    "paper": StageOptions(
        head=HeadOptions(
            width=768,
            centres_per_scene=100,
            condition="descriptor",
            whiten=False,
            activation="relu",
        ),
        fit=FitOptions(
            iterations=15_000,
            batch=40_960,
            replay_batch=40_960,
            peak_rate=5e-3,
            matrix_rate=0.0,
            warm_share=0.3,
            loss=LossOptions(schedule="circle", clamp_start_px=50.0),
        ),
        encode=EncodePlan(views_per_frame=8, cells=1024, most_rows=16_000_000),
    ),
}


def preset(name: str, seed: int = 0) -> StageOptions:
    """Return a preset with a seed for all random draws."""
    return replace(PRESETS[name], seed=seed)


SHORT_SIDE = 240
"""Short side of the working images, pixels."""
PAPER_SHORT_SIDE = 480
"""Maximum short side of the paper's working images, pixels."""
PAPER_SIM_STEPS = 5_000
"""Steps per scene of preset `paper` on the paper's simulation."""


def short_side(name: str, frames: Iterable[Frame]) -> int:
    """Return the short side of the working images, pixels: 240, for the paper up to 480.

    The paper's are not larger than the frames, which would show nothing more.
    """
    if name != "paper":
        return SHORT_SIDE
    side = PAPER_SHORT_SIDE
    for frame in frames:
        side = min(side, frame.camera.width, frame.camera.height)
    return max(SHORT_SIDE, side)


def on_paper_backbone(options: StageOptions) -> StageOptions:
    """Replace network and training by the paper's; width, steps and rows of a step stay.

    Training is by AdamW and reprojection alone. Every stage has the full peak rate.
    """
    fit = replace(
        PRESETS["paper"].fit,
        iterations=options.fit.iterations,
        batch=options.fit.batch,
        replay_batch=options.fit.replay_batch,
    )
    return replace(with_paper_head(options), fit=fit)


def with_paper_head(options: StageOptions) -> StageOptions:
    """Replace the network by the paper's, trained as before; its width stays.

    The head reads the descriptor, has fixed centres (`fixed_centres_m`) and no whitening.
    """
    head = replace(PRESETS["paper"].head, width=options.head.width, centres="fixed")
    return replace(options, head=head)


BACKBONES: dict[str, Callable[[StageOptions], StageOptions]] = {
    "evercal": lambda options: options,
    "paper": on_paper_backbone,
    "paper_head": with_paper_head,
}
"""Network of a stage: ours, the paper's with its training, or the paper's trained as ours."""
