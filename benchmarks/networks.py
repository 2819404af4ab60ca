"""The experiments of research/protocol.md: `evercal bench` with tuned strategies.

Every experiment resumes where it was interrupted. The same call in a second terminal shares the
runs. To publish one, copy its folder without `runs` and `features` to results/.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from tyro.conf import Positional

from evercal.cli.args import Device
from evercal.cli.bench import Bench
from evercal.continual.learning.presets import preset
from evercal.continual.strategies import Strategy, strategy_named
from evercal.errors import InputError

STEPS = preset("converged").fit.iterations
"""Steps a room of `a`. Joint training needs twice as many in `c` and `real`, and four times as many
with the paper's head."""
SEEDS = "0,1,2,3,4,5"
"""All orders of three rooms."""
MORE_SEEDS = "0,1,2,3,4,5,6,7,8,9,10,11"
"""All orders of three rooms, twice."""
FEW_SEEDS = "0,1,2"
"""Three orders: each room is first, second and last once."""
COMPARED = ("sars_spdd", "er", "sars_reprojection", "reservoir_spdd")
"""Strategies of every experiment but that of the paper."""
CONTRASTS = (*COMPARED, "icarl", "buff_cs", "sars_old_output")
"""Strategies of the contrasts that were named before the runs."""
FILLED = (*COMPARED, "sars_spdd_filled")
"""Strategies whose memory is varied."""
BOUNDED = (*FILLED, "joint", "finetune")
"""The same beside joint training and fine-tuning, the best and the worst case."""
CONTROLS = ("evercal", "sars_pixels", "joint", "isolation", "finetune")
"""Strategies without a method of continual learning."""
AT_480 = (
    "sars_spdd_filled",
    "reservoir_spdd",
    "sars_reprojection",
    "er",
    "gdr",
    "gec",
)
"""Strategies of experiment D."""
PAPER = (
    "sars_spdd",
    "joint",
    "finetune",
    "icarl",
    "buff_cs",
    "gec",
    "gdr",
    "er",
    "sars_spdd_filled",
    "reservoir_spdd",
    "sars_reprojection",
)
"""Strategies of the paper's table."""


@dataclass(frozen=True)
class Experiment(Bench):
    """`evercal bench` with given strategies."""

    compared: tuple[Strategy, ...] = ()
    """Strategies, the first of which the others are compared with."""

    def _strategies(self) -> tuple[Strategy, ...]:
        return self.compared


def chosen(names: Sequence[str], paper_head: bool = False) -> tuple[Strategy, ...]:
    """Return strategies by name, with the weights of our network or of the paper's."""
    return tuple(strategy_named(name, paper_head) for name in names)


def experiments(
    data: Path, out: Path, device: Device
) -> Mapping[str, Sequence[Experiment]]:
    """Return the calls of every experiment, in order."""
    every = dict.fromkeys((*CONTROLS, *CONTRASTS, "gec"))

    def bench(suite: str, name: str, names: Sequence[str], seeds: str) -> Experiment:
        return Experiment(
            suite,
            data=data / suite,
            out=out / name,
            order="balanced",
            preset="converged",
            seeds=seeds,
            compared=chosen(names),
            device=device,
        )

    gate = bench("sim-mini", "networks-a", ["joint"], SEEDS)
    head = bench("sim-mini", "networks-b", ["joint"], FEW_SEEDS)
    head = replace(head, steps=4 * STEPS, backbone="paper_head")
    tuned_head = chosen([*COMPARED, "finetune"], paper_head=True)
    unseen = bench("sim-unseen", "networks-c", BOUNDED, FEW_SEEDS)
    unseen = replace(unseen, steps=2 * STEPS)
    real = bench("real2", "networks-real", BOUNDED, FEW_SEEDS)
    paper = bench("sim-unseen", "networks-paper", (), "0")
    memory = []
    for share in (1, 3, 30):
        name = f"networks-memory-{share}"
        shared = bench("sim-mini", name, FILLED, FEW_SEEDS)
        memory.append(replace(shared, memory=f"{share}%"))
    return {
        "gate": [gate],
        "a": [
            replace(gate, compared=chosen([*every])),
            replace(gate, compared=chosen(CONTRASTS), seeds=MORE_SEEDS),
        ],
        "memory": memory,
        "b": [head, replace(head, compared=tuned_head)],
        "c": [unseen, replace(unseen, compared=chosen(["evercal"]), seeds="0")],
        **at_480(unseen, data / "sim-unseen-480", out),
        "share": shares(gate, out),
        "real": [replace(real, steps=2 * STEPS)],
        "paper": [
            replace(
                paper,
                preset="paper",
                order=Bench.order,
                compared=chosen(PAPER, paper_head=True),
            )
        ],
    }


def at_480(
    unseen: Experiment, data: Path, out: Path
) -> Mapping[str, Sequence[Experiment]]:
    """Return experiment C on rooms of 640x480 pixels, and its gate: joint training."""
    rows = replace(unseen, data=data, out=out / "networks-d", short_side=480)
    rows = replace(rows, compared=chosen(["joint", *AT_480]))
    gate = replace(rows, seeds="0", compared=chosen(["joint"]))
    half = replace(gate, short_side=240, out=out / "networks-d-240")
    doubled = replace(gate, steps=4 * STEPS, out=out / "networks-d-4800")
    return {"d-gate": [half, gate, doubled], "d": [rows]}


def shares(gate: Experiment, out: Path) -> Sequence[Experiment]:
    """Return runs of SPDD with other shares of replayed rows and weights, on held-out frames."""
    filled = strategy_named("sars_spdd_filled")
    trials = []
    for weight in (3.0, 10.0):
        named = f"{filled.name}@{weight:g}"
        trials.append(replace(filled.weighted(weight), name=named))
    sweep = replace(gate, compared=tuple(trials), seeds="0", held_out=True)
    experiments = []
    for share in (0.5, 1.0, 2.0):
        folder = out / f"networks-share-{share:g}"
        experiments.append(replace(sweep, replay=share, out=folder))
    return experiments


def run(
    names: Positional[tuple[str, ...]],
    data: Path = Path("runs"),
    out: Path = Path("runs"),
    device: Device = "auto",
) -> int:
    """Run experiments of research/protocol.md; each resumes.

    Args:
        names: gate (joint training of `a`, whose accuracy decides whether the others are run), a,
            memory, b, c, d-gate and d (rooms of 640x480), share (replayed rows of SPDD), real
            (needs the recordings) and paper (needs a GPU).
        data: Folder of the rooms, rendered with `python -m rooms SUITE --out DATA/SUITE`.
        out: Folder of results.
        device: Device of the networks: auto, cpu or cuda.
    """
    known = experiments(data, out, device)
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        raise InputError(
            f"{' '.join(unknown) or 'no experiment'}: choose of {', '.join(known)}"
        )
    for name in names:
        for experiment in known[name]:
            experiment.run()
    return 0
