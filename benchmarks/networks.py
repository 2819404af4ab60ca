"""The experiments of docs/experiments/protocol.md, from rendering to tables and figure.

Every command resumes where it was interrupted. The same call in a second terminal shares the runs.
"""

import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from evercal.continual.benchmark.rows import read_rows
from tyro.conf import Positional

from benchmarks.trainer import step_seconds
from benchmarks.tuning import DERIVED
from evercal.continual.learning.presets import PAPER_SIM_STEPS, preset
from evercal.errors import InputError
from evercal.storage import write_json

ROOT = Path(__file__).resolve().parent.parent
ROWS = "results/tuned-converged.json"
PAPER_HEAD_ROWS = "results/tuned-paper-head.json"
CONTROLS = "evercal,evercal_network,joint,isolation,finetune"
SELECTED = ("er", "sars_reprojection", "reservoir_spdd", "sars_spdd")
SELECTIONS: Mapping[str, Sequence[str]] = {
    "networks-contrasts.json": (*SELECTED, "icarl", "buff_cs", "sars_old_output"),
    "networks-filled.json": (*SELECTED, "sars_spdd_filled"),
}
"""Files of some tuned rows, in the folder of runs."""
CONTRASTS, FILLED = SELECTIONS
STEPS = preset("converged").fit.iterations
"""Steps a room of `a`. Joint training needs twice as many in `c` and `real`, and four times as many
with the paper's head."""
SEEDS = "0,1,2,3,4,5"
"""All orders of three rooms (`--order balanced`)."""
MORE_SEEDS = "0,1,2,3,4,5,6,7,8,9,10,11"
FEW_SEEDS = "0,1,2"
"""Three orders: each room is first, second and last once."""
SHARES = (1, 3, 30)
"""Memory, per cent of the frames; `a` has 10."""
PAPER_STAGES = 14
"""Stages of three rooms: joint training counts three, the first room is shared."""

Command = Sequence[str]


def commands(data: Path, out: Path) -> Mapping[str, Sequence[Command]]:
    """Return the commands of every experiment, in order."""

    def rooms(suite: str) -> Command:
        return "evercal", "simulate", suite, "--sweep-only", "--out", str(data / suite)

    def bench(suite: str, name: str, *options: str) -> Command:
        folders = ("--data", str(data / suite), "--out", str(out / name))
        return "evercal", "bench", suite, *folders, *options

    def tune(
        file: str, folder: str, methods: Command, rows: Command, *options: str
    ) -> Sequence[Command]:
        trials = (
            *("benchmarks", "tune", "sim-tune", "--data", str(data / "sim-tune")),
            *("--methods", *methods, "--rows", *rows),
            *("--file", file, "--out", str(out / folder), *options),
        )
        outcomes = file.replace(".json", ".outcomes.json")
        return [rooms("sim-tune"), trials, ("benchmarks", "publish", outcomes, Path(file).stem)]

    def gated(suite: str, name: str, rows: Command, *options: str) -> Sequence[Command]:
        joint = ("--strategies", "joint", "--seeds", FEW_SEEDS)
        others = (*rows, "--strategies", "joint,finetune", "--seeds", FEW_SEEDS)
        return [bench(suite, name, *options, *joint), bench(suite, name, *options, *others)]

    def publish(name: str) -> Command:
        return "benchmarks", "publish", str(out / name), name

    tuned = ("--preset", "converged", "--order", "balanced")
    doubled = (*tuned, "--steps", str(2 * STEPS))
    head = ("--backbone", "paper_head")
    methods = ("er", "icarl", "buff_cs", "sars_spdd", "gec")
    rows = (*methods, "sars_old_output", "sars_reprojection", "reservoir_spdd")
    return {
        "tune": tune(ROWS, "tune", methods, rows),
        "gate": [
            rooms("sim-mini"),
            bench("sim-mini", "networks-a", *tuned, "--strategies", "joint", "--seeds", SEEDS),
        ],
        "a": [
            rooms("sim-mini"),
            bench(
                *("sim-mini", "networks-a", *tuned, "--rows", ROWS),
                *("--strategies", CONTROLS, "--seeds", SEEDS),
            ),
            bench(
                *("sim-mini", "networks-a", *tuned, "--rows", str(out / CONTRASTS)),
                *("--seeds", MORE_SEEDS),
            ),
            publish("networks-a"),
        ],
        "memory": [
            rooms("sim-mini"),
            *(
                command
                for share in SHARES
                for name in [f"networks-memory-{share}"]
                for command in (
                    bench(
                        *("sim-mini", name, *tuned, "--rows", str(out / FILLED)),
                        *("--memory", f"{share}%", "--seeds", FEW_SEEDS),
                    ),
                    publish(name),
                )
            ),
        ],
        "b": [
            *tune(
                *(PAPER_HEAD_ROWS, "tune-paper-head", ("er", "sars_spdd"), SELECTED, *head),
                *("--steps", str(STEPS // 2)),
            ),
            rooms("sim-mini"),
            *gated(
                *("sim-mini", "networks-b", ("--rows", PAPER_HEAD_ROWS)),
                *(*tuned, "--steps", str(4 * STEPS), *head),
            ),
            publish("networks-b"),
        ],
        "c": [
            rooms("sim-unseen"),
            *gated("sim-unseen", "networks-c", ("--rows", str(out / FILLED)), *doubled),
            bench(
                *("sim-unseen", "networks-c", *doubled, "--strategies", "evercal", "--seeds", "0")
            ),
            publish("networks-c"),
        ],
        "real": [
            bench(
                *("real2", "networks-real", *doubled, "--rows", str(out / FILLED)),
                *("--strategies", "joint,finetune", "--seeds", FEW_SEEDS),
            ),
            publish("networks-real"),
        ],
        "paper": [
            rooms("sim-unseen"),
            bench(
                *("sim-unseen", "networks-paper", "--preset", "paper"),
                *("--strategies", "joint,finetune,icarl,buff_cs,gec,sars_spdd", "--seeds", "0"),
            ),
            publish("networks-paper"),
        ],
        "tables": [("benchmarks", "tables"), ("benchmarks", "network-figure", "networks-a")],
    }


def run(
    experiments: Positional[tuple[str, ...]],
    data: Path = Path("runs"),
    out: Path = Path("runs"),
    dry: bool = False,
    device: str = "auto",
) -> int:
    """Run experiments of docs/experiments/protocol.md; each resumes.

    Args:
        experiments: gate (joint training of `a`, whose accuracy decides whether the others are
            run), tune, a, memory, b, c, real (needs the recordings), paper (needs a GPU) and
            tables, in this order.
        data: Folder of the rendered rooms.
        out: Folder of runs and results.
        dry: Print the commands, and for `paper` the estimated hours, and run nothing.
        device: Device of the networks: auto, cpu or cuda.
    """
    known = commands(data, out)
    unknown = [name for name in experiments if name not in known]
    if unknown or not experiments:
        raise InputError(f"{' '.join(unknown) or 'no experiment'}: choose of {', '.join(known)}")
    if "paper" in experiments:
        print(f"paper: about {paper_hours(device):.1f} hours of training on this machine")
    for command in (command for name in experiments for command in known[name]):
        print(" ".join(command), flush=True)
        if dry:
            continue
        for name, rows in SELECTIONS.items():
            if str(out / name) in command:
                write_json(out / name, _tuned(rows))
        began = time.perf_counter()
        code = subprocess.run(_words(command, device), cwd=ROOT, check=False).returncode
        print(f"{time.perf_counter() - began:.0f} s", flush=True)
        if code:
            return code
    return 0


def paper_hours(device: str) -> float:
    """Estimate the hours of training of `paper`, from some steps with random rows."""
    options = preset("paper")
    seconds = step_seconds(options.head, options.fit, device=device)
    return seconds * PAPER_SIM_STEPS * PAPER_STAGES / 3600


def _tuned(names: Sequence[str]) -> list[dict]:
    """Return tuned rows by name; `DERIVED` ones take the setting of another."""
    rows = {row["name"]: row for row in read_rows(str(ROOT / ROWS))}
    return [{**rows[DERIVED[n]], "name": n, "of": n} if n in DERIVED else rows[n] for n in names]


def _words(command: Command, device: str) -> list[str]:
    """Return the words of a process."""
    first, *rest = command
    chosen = ("--device", device) if rest[0] == "bench" else ()
    return [sys.executable, "-m", first, *rest, *chosen]
