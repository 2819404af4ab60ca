"""Recordings learned and a map served by a Ray cluster, beside one process.

The cluster has two nodes on this machine. Drawn recordings are learned by one process, and by Ray
with two and four workers, while a worker is killed every ten seconds, and while a node is removed.
A served map answers four clients.
"""

import itertools
import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.rows import Row, once, save
from evercal import Client, Map
from evercal.processes import python_command
from evercal.recordings import Frame, Recording
from evercal.recordings.formats import generic
from evercal.service.hosts import listening_socket
from evercal.simulation.box_room import BoxRoom, default_camera

FIRST_SEED = 40_000
FRAMES = 60
KILL_S = 10.0
TOKEN = "the-token-of-a-benchmark"
CLIENTS = 4


def run(
    out: Path = Path("runs/cluster"), recordings: int = 24, requests: int = 200
) -> None:
    """Learn drawn recordings and serve their map, with and without Ray.

    Args:
        out: Folder of recordings, maps and rows; complete rows are not repeated.
        recordings: Drawn recordings.
        requests: Images that a service locates.
    """
    paths = [_drawn(out / "recordings", number) for number in tqdm(range(recordings))]
    ways: dict[str, Callable[[], Row]] = {
        "one process": lambda: _learned(out, paths, "one", None),
        "Ray, 2 workers": lambda: _learned(out, paths, "two", (1, 1)),
        "Ray, 4 workers": lambda: _learned(out, paths, "four", (2, 2)),
        "Ray, 2 workers, a kill every 10 s": lambda: _learned(
            out, paths, "kill", (1, 1), True
        ),
        "Ray, 3 workers, a node removed": lambda: _learned(
            out, paths, "gone", (1, 1, 1), gone=True
        ),
        "evercal serve": lambda: _served(out / "one", paths, requests, ()),
        "Ray Serve, 1 replica": lambda: _on_ray(out / "one", paths, requests, 1),
        "Ray Serve, 2 replicas": lambda: _on_ray(out / "one", paths, requests, 2),
    }
    rows = []
    for name, measure in ways.items():
        file = out / f"{name.replace(' ', '-')}.json"
        rows.append(once(file, lambda n=name, m=measure: {"way": n, **m()}))
    save(out / "cluster.csv", rows, {"recordings": recordings, "requests": requests})


def _drawn(root: Path, number: int) -> Path:
    path = root / f"room-{number:02d}"
    if not path.exists():
        room = BoxRoom(FIRST_SEED + number)
        camera = default_camera()
        poses = room.path(FRAMES, number)
        frames = [
            Frame(f"{i:03d}", room.render(camera, poses[i]), camera, poses[i])
            for i in range(FRAMES)
        ]
        test = tuple(frames[5::10])
        train = tuple(frame for frame in frames if frame not in test)
        part = root / f".{path.name}"
        shutil.rmtree(part, ignore_errors=True)
        generic.write(part, Recording(path.name, train, test))
        part.rename(path)
    return path


def _learned(
    out: Path,
    paths: list[Path],
    name: str,
    nodes: tuple[int, ...] | None,
    kill: bool = False,
    gone: bool = False,
) -> Row:
    shutil.rmtree(out / name, ignore_errors=True)
    opened = Map.open(out / name)
    if nodes is None:
        with _processor_time(b"") as spent:
            began = time.perf_counter()
            opened.learn_many(paths, workers=1)
            return {"wall_s": time.perf_counter() - began, "processor_s": spent()}
    with _cluster(*nodes) as made, _processor_time(b"ray::") as spent:
        stop = threading.Event()
        killed = list[int]()
        if kill:
            threading.Thread(target=_kill, args=(stop, killed)).start()

        def learned(_: object) -> None:
            if gone and len(opened.scenes) == 3:
                made.remove_node(made.last)

        began = time.perf_counter()
        try:
            opened.learn_many(paths, ray=made.address, on_scene=learned)
        finally:
            stop.set()
        row: Row = {"wall_s": time.perf_counter() - began, "processor_s": spent()}
        same = _contents(out / name) == _contents(out / "one")
        return row | {"killed": len(killed), "same_map": float(same)}


def _contents(root: Path) -> dict[str, bytes]:
    """All files of a map but those that state how long it took."""
    files = (path for path in root.rglob("*") if path.is_file())
    varying = ("report.json", "manifest.json")
    return {
        str(f.relative_to(root)): f.read_bytes() for f in files if f.name not in varying
    }


@contextmanager
def _cluster(*nodes: int) -> Iterator[Any]:
    from ray.cluster_utils import Cluster

    head, *others = nodes
    made: Any = Cluster(initialize_head=True, head_node_args={"num_cpus": head})
    for cores in others:
        made.last = made.add_node(num_cpus=cores)
    try:
        yield made
    finally:
        made.shutdown()


def _processes(begin: bytes) -> Iterator[Path]:
    """Folders in /proc of processes whose command begins so; of local workers without."""
    for file in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):
            command = file.read_bytes()
            if command.startswith(begin) if begin else b"spawn_main" in command:
                yield file.parent


@contextmanager
def _processor_time(begin: bytes) -> Iterator[Callable[[], float]]:
    """Seconds of processor time that processes spend meanwhile."""
    spent = dict[str, int]()
    stop = threading.Event()

    def watch() -> None:
        while not stop.wait(0.2):
            for process in _processes(begin):
                with suppress(OSError):
                    fields = (process / "stat").read_text().rpartition(")")[2].split()
                    spent[process.name] = int(fields[11]) + int(fields[12])

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield lambda: sum(spent.values()) / os.sysconf("SC_CLK_TCK")
    finally:
        stop.set()
        thread.join()


def _kill(stop: threading.Event, killed: list[int]) -> None:
    while not stop.wait(KILL_S):
        for process in itertools.islice(_processes(b"ray::_learned"), 1):
            with suppress(OSError):
                os.kill(int(process.name), signal.SIGKILL)
                killed.append(int(process.name))


def _on_ray(store: Path, paths: list[Path], requests: int, replicas: int) -> Row:
    with _cluster(2, 2) as made:
        words = ("--ray", made.address, "--replicas", replicas)
        return _served(store, paths, requests, words)


def _served(
    store: Path, paths: list[Path], requests: int, words: tuple[object, ...]
) -> Row:
    """Images a second, and whether answers are those of the map."""
    with listening_socket("127.0.0.1", 0) as listener:
        port = listener.getsockname()[1]
    command = python_command(
        "-m", "evercal", "serve", *map(str, (store, "--port", port, *words))
    )
    environment = {**os.environ, "EVERCAL_TOKEN": TOKEN}
    opened = Map.open(store)
    images = [generic.load(path).test[2].read_image() for path in paths]
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None, "it is a pipe"
        process.stdout.readline()
        client = Client(f"http://127.0.0.1:{port}", TOKEN)
        asked = [images[i % len(images)] for i in range(requests)]
        times: list[float] = []

        def ask(image: np.ndarray) -> object:
            began = time.perf_counter()
            estimate = client.localize(image)
            times.append(1000 * (time.perf_counter() - began))
            return estimate

        begin = b"ray::" if words else b"\0".join(word.encode() for word in command)
        with ThreadPoolExecutor(CLIENTS) as pool, _processor_time(begin) as spent:
            # Not counted: every replica decodes the keyframes.
            answers = list(pool.map(ask, images * 4))[: len(images)]
            times.clear()
            time.sleep(1.0)
            before = spent()
            began = time.perf_counter()
            _ = list(pool.map(ask, asked))
            seconds = time.perf_counter() - began
            time.sleep(1.0)
            worked = spent() - before
        process.send_signal(signal.SIGTERM)
        process.wait(90)
    same = [
        _same(opened.localize(i), answer)
        for i, answer in zip(images, answers, strict=True)
    ]
    return {
        "images_per_s": requests / seconds,
        "median_ms": float(np.median(times)),
        "processor_ms": 1000 * worked / requests,
        "same_answers": float(np.mean(same)),
    }


def _same(ours: Any, theirs: Any) -> bool:
    if ours.base_from_camera is None:
        return theirs.base_from_camera is None and ours.status == theirs.status
    both = (ours.base_from_camera.matrix(), theirs.base_from_camera.matrix())
    return ours.scene == theirs.scene and bool(np.array_equal(*both))
