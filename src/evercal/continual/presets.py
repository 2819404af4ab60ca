"""Presets: how much work a scene gets."""

from dataclasses import replace
from typing import Literal

from evercal.continual.networks.buffer import EncodePlan
from evercal.continual.networks.head import HeadOptions
from evercal.continual.networks.loss import LossOptions
from evercal.continual.networks.trainer import FitOptions
from evercal.continual.stage import StageOptions

Preset = Literal["fast", "demo", "bench", "paper"]

PRESETS: dict[str, StageOptions] = {
    # 2 cores, at most 240 s a scene.
    "fast": StageOptions(
        head=HeadOptions(width=384),
        fit=FitOptions(iterations=2400, batch=2048, replay_batch=1024),
        encode=EncodePlan(views_per_frame=4),
    ),
    # At most 45 s a scene of about 100 frames.
    "demo": StageOptions(
        head=HeadOptions(width=256),
        fit=FitOptions(iterations=1000, batch=2048, replay_batch=1024),
        encode=EncodePlan(views_per_frame=3),
        replay_views_per_frame=4,
    ),
    # At most 45 s a stage on one core. Twice the rows cost twice the time and are as accurate on
    # held-out frames; half the steps are not.
    "bench": StageOptions(
        head=HeadOptions(width=256),
        fit=FitOptions(iterations=600, batch=1024, replay_batch=512),
        encode=EncodePlan(views_per_frame=1),
        replay_views_per_frame=2,
    ),
    # The paper's settings, for a GPU: AdamW at 0.005, 15,000 steps a scene, SARS and SPDD as their
    # options say. The rows of a step are GLACE's; the paper says "a mini-batch of replay samples",
    # here as many. The lens is left as it is stated.
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
            muon_rate=0.0,
            intrinsics_rate=0.0,
            warm_share=0.3,
            loss=LossOptions(schedule="circle", clamp_start_px=50.0),
        ),
        encode=EncodePlan(views_per_frame=8, cells=1024),
    ),
}


def preset(name: str, seed: int = 0) -> StageOptions:
    """A preset with everything drawn from `seed`."""
    options = PRESETS[name]
    return replace(options, seed=seed, encode=replace(options.encode, seed=seed))


PAPER_SIM_STEPS = 5_000
"""Steps a scene of preset `paper` on the paper's own simulation."""


def short_side(name: str) -> int:
    """Working size of images, pixels: the paper's is 480."""
    return 480 if name == "paper" else 240


def on_paper_backbone(options: StageOptions) -> StageOptions:
    """As much work with the paper's network and optimiser in place of ours.

    The descriptor in the input, centres that are known in advance (`fixed_centres_m`), no
    whitening, and every stage at the full peak rate; width, steps and rows of a step stay.
    """
    paper = PRESETS["paper"]
    head = replace(paper.head, width=options.head.width, centres="fixed")
    work = {name: getattr(options.fit, name) for name in ("iterations", "batch", "replay_batch")}
    return replace(options, head=head, fit=replace(paper.fit, **work))
