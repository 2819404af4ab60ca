"""`python -m rooms SUITE --out DIR`: render a suite of furnished rooms."""

import sys
from pathlib import Path
from typing import Annotated

import tyro
from tqdm import tqdm
from tyro.conf import Positional

from evercal.errors import InputError
from rooms.suites import SUITES, SimulateOptions, simulate


def run(
    suite: Positional[str],
    out: Path,
    options: Annotated[SimulateOptions, tyro.conf.arg(name="")] = SimulateOptions(),  # noqa: B008
) -> None:
    """Render furnished rooms with a Franka Panda and exact poses.

    Args:
        suite: Three rooms (sim), seven (sim-7), twelve (sim-12), the packaged ones (sim-mini),
            three for tuning networks (sim-tune), three for confirming them (sim-unseen), or three
            with repeated textures and objects (sim-repeat).
        out: Output folder. The same command continues an interrupted run.
        options: Settings; those that are None are the suite's.
    """
    with tqdm(desc="rendering", unit="frame") as bar:
        for progress in simulate(suite, out, options):
            if bar.total is None:
                bar.write(f"rendering with {progress.renderer}", file=sys.stderr)
                bar.total = progress.total
            bar.update(progress.done - bar.n)
    print(f"next: evercal inspect {out / SUITES[suite].rooms[0][0]}")


def main(args: list[str]) -> int:
    """Render, and return the exit code."""
    try:
        tyro.cli(run, args=args, prog="python -m rooms")
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
