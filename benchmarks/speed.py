"""Time and memory of learning, localization and a cold start, beside another version."""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.rows import save
from evercal.errors import InputError
from evercal.processes import python_command

_ROOT = Path(__file__).resolve().parents[1]
_AVX2 = {
    "OPENCV_CPU_DISABLE": "AVX512_SKX,AVX512_CLX,AVX512F",
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
    "OPENBLAS_CORETYPE": "Haswell",
    "ATEN_CPU_CAPABILITY": "avx2",
    "ONEDNN_MAX_CPU_ISA": "AVX2",
    "EVERCAL_PRECISION": "float32",
}
"""Variables that limit OpenCV, NumPy, OpenBLAS and PyTorch to the instructions of AVX2."""

_MEASURE = """
import json, sys, time
from pathlib import Path
import numpy as np
from evercal.map import Map
from evercal.recordings import load_recording
from evercal.recordings.samples import sample_rooms

def timed(work):
    wall, busy = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - wall, time.process_time() - busy

folder, scene = Path(sys.argv[1]), sys.argv[2]
quiet = {"on_progress": lambda *_: None}
rooms, out = [room.scene for room in sample_rooms()], {}
whole, rest = Map.open(folder / "whole"), Map.open(folder / "rest")
out["learn a room, s"], out["learn a room, processor s"] = np.median(
    [timed(lambda r=room: whole.learn(r, **quiet)) for room in rooms], 0
).tolist()
for room in rooms[1:]:
    rest.learn(room, **quiet)
images = [frame.read_image() for room in rooms for frame in room.test]
strange = [frame.read_image() for frame in rooms[0].test[::2]]
for name, cell, shown in (("image", whole, images), ("unknown room", rest, strange)):
    for image in shown[::8]:
        cell.localize(image)
    times = 1000 * np.array([timed(lambda i=image: cell.localize(i)) for image in shown])
    out[f"{name}, ms"], out[f"{name}, processor ms"] = np.median(times, 0).tolist()
    out[f"{name}, 90 %, ms"] = float(np.quantile(times[:, 0], 0.9))
frames, began = [images[i] for i in range(0, len(images), 10) for _ in range(8)], []
for tracked in whole.track(iter(frames)):
    began.append((time.perf_counter(), tracked.state))
steps = [1000 * (b[0] - a[0]) for a, b in zip(began, began[1:]) if b[1] == "tracking"]
out["tracked frame, ms"] = float(np.median(steps))
if scene:
    recording = load_recording(Path(scene))
    new = Map.open(folder / "long")
    out["learn SCENE, s"], out["learn SCENE, processor s"] = timed(
        lambda: new.learn(recording, memory="10%", **quiet)
    )
print(json.dumps(out))
"""


def run(
    out: Path = Path("runs/speed.csv"),
    beside: Path | None = None,
    repeat: int = 3,
    scene: Path | None = None,
    avx2: bool = False,
    demo: bool = False,
) -> None:
    """Time this version, and alternately another one, each in processes of its own.

    Images are decoded before. A room that is missing in a map stands for an unknown one. A tracked
    frame shows the image before once more.

    Args:
        out: File of rows to write.
        beside: Folder of another checkout, such as one of `git worktree add`.
        repeat: Times that each version is measured; medians count.
        scene: Recording to learn beside the packaged rooms.
        avx2: Use no instructions that processors with AVX2 lack.
        demo: Time `evercal demo`, too.
    """
    trees = [_ROOT] if beside is None else [beside.resolve(), _ROOT]
    for tree in trees:
        if not (tree / "src" / "evercal").is_dir():
            raise InputError(f"--beside {tree}: no checkout of evercal")
    found: list[list[dict[str, float]]] = [[] for _ in trees]
    for number in range(repeat):
        for tree, measured in zip(trees, found, strict=True):
            measured.append(_measured(tree, scene, avx2, demo))
            print(f"{number + 1} of {repeat}: {tree}", file=sys.stderr, flush=True)
    rows: list[dict[str, str | float]] = []
    for name in found[-1][0]:
        values = [float(np.median([m[name] for m in measured])) for measured in found]
        row: dict[str, str | float] = {"what": name, "now": values[-1]}
        rows.append(
            row
            if beside is None
            else {**row, "beside": values[0], "ratio": values[-1] / values[0]}
        )
    save(out, rows, {"repeat": repeat, "avx2": avx2, "scene": scene and scene.name})


def _measured(
    tree: Path, scene: Path | None, avx2: bool, demo: bool
) -> dict[str, float]:
    environment = {
        **os.environ,
        "PYTHONPATH": str(tree / "src"),
        **(_AVX2 if avx2 else {}),
    }

    def called(*words: str) -> tuple[str, float, float, float]:
        """Output, seconds, processor seconds and peak MB of a process."""
        command = python_command(*words)
        with tempfile.TemporaryFile() as printed:
            process = subprocess.Popen(
                command,
                stdout=printed,
                stderr=subprocess.DEVNULL,
                env=environment,
                cwd=tree,
            )
            began = os.times().elapsed
            _, status, used = os.wait4(process.pid, 0)
            if status:
                raise InputError(
                    f"{tree}: {' '.join(words)[:40]!r} ended with {status}"
                )
            printed.seek(0)
            busy = used.ru_utime + used.ru_stime
            return (
                printed.read().decode(),
                os.times().elapsed - began,
                busy,
                used.ru_maxrss / 1024,
            )

    with tempfile.TemporaryDirectory() as scratch:
        found = json.loads(
            called("-c", _MEASURE, scratch, str(scene or ""))[0].splitlines()[-1]
        )
        images = sorted(
            map(str, _ROOT.glob("src/evercal/recordings/sample_rooms/*/images/*"))
        )[::4]
        locate = ["-m", "evercal", "localize", f"{scratch}/whole", "--json"]
        _, _, found["cold start, processor s"], _ = called(*locate, images[0])
        _, _, _, found["peak of locating, MB"] = called(*locate, *images)
        if demo:
            words = ["-m", "evercal", "demo", "--out", f"{scratch}/demo"]
            _, found["demo, s"], found["demo, processor s"], _ = called(*words)
    return found
