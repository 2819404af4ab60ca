"""Commands that are killed, or meet a full or a read-only disk: what is left of the map.

Each command runs in a forked process on a copy of a map. It is killed at a random time, or at one
of its file operations. Afterwards the map must open with all checksums right, locate an image as
before, hold the scenes from before or after the command, and take the command again.
"""

import contextlib
import importlib
import io
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tabulate import tabulate
from tqdm import tqdm

from evercal.errors import InputError

WRITES = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "os.link")
LONGEST_S = 180.0
_LOADED = (
    "evercal.cli",
    "evercal.cli.learn",
    "evercal.learning.scene",
    "evercal.localization.refreshing",
    "evercal.map",
    "evercal.mapping.manage",
    "evercal.mapping.refresh",
    "benchmarks.fault_rooms",
)
_PAGE = 4096
"""Files take whole pages of a disk in memory."""


@dataclass(frozen=True)
class Command:
    """A command that changes a map."""

    words: tuple[str, ...]
    """Words of `evercal`; MAP is the copy, FILES the folder of the recordings."""
    before: frozenset[str]
    """Scenes before it."""
    after: frozenset[str]
    """Scenes after it."""

    def with_paths(self, store: Path, files: Path) -> list[str]:
        """Words of `evercal`."""
        return [word.replace("MAP", str(store)).replace("FILES", str(files)) for word in self.words]


BOTH, ONE = frozenset({"hall", "yard"}), frozenset({"hall"})
COMMANDS = {
    "learn": Command(("learn", "MAP", "FILES/shed"), BOTH, BOTH | {"shed"}),
    "refresh": Command(("refresh", "MAP", "FILES/images"), BOTH, BOTH),
    "undo": Command(("refresh", "MAP", "--undo", "hall"), BOTH, BOTH),
    "remove": Command(("map", "remove", "MAP", "yard"), BOTH, ONE),
    "rename": Command(("map", "rename", "MAP", "yard", "garden"), BOTH, ONE | {"garden"}),
    "merge": Command(("map", "merge", "MAP", "FILES/other"), BOTH, BOTH | {"other"}),
}


def run(
    kills: int = 200,
    seed: int = 0,
    commands: tuple[str, ...] = tuple(COMMANDS),
    folder: Path = Path("runs/faults"),
    out: Path = Path("runs/faults.json"),
) -> None:
    """Kill commands, fill disks, and count what is left.

    Args:
        kills: Kills of all commands together.
        seed: Seed of the times.
        commands: Commands to run.
        folder: Folder for maps and recordings; it is made anew.
        out: File for the counts, JSON.
    """
    for module in _LOADED:  # once, before processes are forked
        importlib.import_module(module)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    made = _forked(lambda: _make(folder))
    if made.status != "done":
        raise InputError(f"{folder}: recordings and maps cannot be made ({made.value})")
    rng, rows = random.Random(seed), []
    for name in commands:
        bench = _Bench(folder, COMMANDS[name], "refreshed" if name == "undo" else "map")
        rows.append(bench.kills(name, rng, kills // len(commands)))
        rows += bench.disks(name)
        print(tabulate(rows, headers="keys"), flush=True)
    out.write_text(json.dumps(rows, indent=1))


@dataclass(frozen=True)
class _Ended:
    """How a forked process ended."""

    status: str
    """done, killed, error, hang."""
    value: Any = None
    seconds: float = 0.0


def _forked(work: Callable[[], Any], kill_after_s: float | None = None) -> _Ended:
    """Run in a forked process; its result is JSON."""
    began = time.monotonic()
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        try:
            answer = json.dumps({"value": work()})
        except BaseException as error:
            answer = json.dumps({"error": f"{type(error).__name__}: {error}"})
        os.write(writing, answer.encode())
        os._exit(0)
    os.close(writing)
    deadline = began + (LONGEST_S if kill_after_s is None else kill_after_s)
    ended = 0
    while not ended and time.monotonic() < deadline:
        ended = os.waitpid(child, os.WNOHANG)[0]
        time.sleep(0.002)
    if not ended:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    with os.fdopen(reading, "rb") as pipe:
        answer = pipe.read()
    spent = time.monotonic() - began
    if answer:
        content = json.loads(answer)
        error = content.get("error")
        return _Ended("error" if error else "done", error or content["value"], spent)
    return _Ended("killed" if ended or kill_after_s is not None else "hang", None, spent)


def _command(words: Sequence[str], die_at: int | None = None) -> dict[str, Any]:
    """Run `evercal` in this process; die at one of its file operations, or count them."""
    from evercal.cli import main

    operations = [0]

    def hook(event: str, args: tuple[Any, ...]) -> None:
        writes = event in WRITES
        if event == "open" and isinstance(args[2], int):
            writes = bool(args[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
        if writes:
            operations[0] += 1
            if operations[0] == die_at:
                os.kill(os.getpid(), signal.SIGKILL)

    text, errors = io.StringIO(), io.StringIO()
    sys.addaudithook(hook)
    with contextlib.redirect_stdout(text), contextlib.redirect_stderr(errors):
        code = main(words)
    lines = [line for line in errors.getvalue().splitlines() if line.startswith("error")]
    traced = "Traceback" in errors.getvalue()
    return {"code": code, "errors": lines, "traced": traced, "operations": operations[0]}


def _state(store: Path, image: Path) -> dict[str, Any]:
    """Scenes and the pose of an image; InputError where the map is damaged."""
    from evercal import Map, read_image
    from evercal.storage.manifest import Manifest

    opened = Map.open(store)
    if problems := Manifest.read(store).problems(store):
        raise InputError(problems[0])
    estimate = opened.localize(read_image(image))
    pose = estimate.base_from_camera
    assert pose is not None, estimate.reason
    return {"scenes": sorted(opened.scenes), "position": pose.translation_m.tolist()}


@dataclass(frozen=True)
class _Bench:
    """Runs one command on copies of a map."""

    folder: Path
    command: Command
    source: str

    def kills(self, name: str, rng: random.Random, count: int) -> dict[str, Any]:
        """Kill the command and check the map."""
        words = self.command.with_paths(self._copy(), self.folder)
        whole = _forked(lambda: _command(words))
        if whole.status != "done" or whole.value["code"] != 0:
            raise InputError(f"{name}: fails undisturbed: {whole}")
        operations = whole.value["operations"]
        places = [
            *(("operation", 1 + i * operations // (count // 2)) for i in range(count // 2)),
            *(("time", rng.uniform(0, whole.seconds)) for _ in range(count - count // 2)),
        ]
        counts: Counter[str] = Counter()
        for kind, place in tqdm(places, desc=name, unit="kill", mininterval=10):
            words = self.command.with_paths(self._copy(), self.folder)
            at = int(place) if kind == "operation" else None
            ended = _forked(
                lambda words=words, at=at: _command(words, at),
                None if kind == "operation" else float(place),
            )
            counts[self._left(ended)] += 1
        return {"command": name, "fault": "kill -9", "runs": len(places), **counts}

    def _left(self, ended: _Ended) -> str:
        """What a fault has left: `before`, `after`, or what is wrong."""
        if ended.status in ("hang", "error"):
            return f"{ended.status}: {ended.value}"
        state = self._checked()
        if state not in ("before", "after"):
            return state
        if state == "before" or self.command.before == self.command.after:
            words = self.command.with_paths(self._store, self.folder)
            again = _forked(lambda: _command(words))
            undone = "--undo" in words and again.status == "done" and again.value["code"] == 2
            if not undone and (again.status != "done" or again.value["code"] != 0):
                return f"not repeatable: {again.value}"
        return self._remains() or state

    def _remains(self) -> str:
        """What is left of the fault after another change."""
        words = ["map", "rename", str(self._store), "hall", "salon"]
        changed = _forked(lambda: _command(words))
        if changed.status != "done" or changed.value["code"] != 0:
            return f"cannot be changed: {changed.value}"
        listed = json.loads((self._store / "manifest.json").read_text())["files"]
        found = {str(p.relative_to(self._store)) for p in self._store.rglob("*") if p.is_file()}
        beside = [path.name for path in self._disk.iterdir() if path.suffix != ".lock"]
        extra = sorted(found - {*listed, "manifest.json"}) + beside[1:]
        return f"left behind: {extra}" if extra else ""

    def _checked(self) -> str:
        image = self.folder / "image.png"
        checked = _forked(lambda: _state(self._store, image))
        if checked.status != "done":
            return f"damaged: {checked.value}"
        was = json.loads((self.folder / "position.json").read_text())
        moved = max(abs(a - b) for a, b in zip(was, checked.value["position"], strict=True))
        if moved > 0.005:
            return f"image moved by {1000 * moved:.1f} mm"
        scenes = frozenset(checked.value["scenes"])
        if scenes == self.command.before:
            return "before"
        return "after" if scenes == self.command.after else f"scenes {sorted(scenes)}"

    def disks(self, name: str) -> Iterator[dict[str, Any]]:
        """Run the command on disks that become full, and on a read-only one."""
        files = [path for path in (self.folder / self.source).rglob("*") if path.is_file()]
        used = sum(_PAGE * (1 + path.stat().st_size // _PAGE) for path in files) + 16 * _PAGE
        for fault, sizes in (
            ("full disk", [round(used + 2 ** (12 + i)) for i in range(12)]),
            ("read-only", [0]),
        ):
            counts: Counter[str] = Counter()
            for free in sizes:
                with _mounted(self.folder / "disk", free or 10**8) as mounted:
                    if not mounted:
                        counts["no mount"] += 1
                        continue
                    self._copy()
                    if not free:
                        subprocess.run(["mount", "-o", "remount,ro", self._disk], check=True)
                    counts[self._refused(free == 0)] += 1
            yield {"command": name, "fault": fault, "runs": len(sizes), **counts}

    def _refused(self, must_refuse: bool) -> str:
        words = self.command.with_paths(self._store, self.folder)
        ended = _forked(lambda: _command(words))
        if ended.status != "done":
            return f"{ended.status}: {ended.value}"
        value = ended.value
        if value["traced"] or (value["code"] != 0 and len(value["errors"]) != 1):
            return f"no single line: {value}"
        state = self._checked()
        if state == "before" and value["code"] == 2:
            return "refused in one line, before"
        if state == "after" and value["code"] == 0 and not must_refuse:
            return "done, after"
        if self.command.before == self.command.after and value["code"] == 0 and not must_refuse:
            return "done, after"
        return f"code {value['code']}, {state}"

    @property
    def _disk(self) -> Path:
        return self.folder / "disk"

    @property
    def _store(self) -> Path:
        return self._disk / "map"

    def _copy(self) -> Path:
        """A fresh copy of the map, also of what lies beside it."""
        self._disk.mkdir(exist_ok=True)
        for path in self._disk.iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        return Path(shutil.copytree(self.folder / self.source, self._store))


@contextlib.contextmanager
def _mounted(folder: Path, size: int) -> Iterator[bool]:
    """A disk of a size in memory; False where this user may not mount one."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    mounted = subprocess.run(mount, capture_output=True, check=False).returncode == 0
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "-l", str(folder)], check=True)


def _make(folder: Path) -> None:
    """Recordings of box rooms, maps of them, and an image with its position."""
    from benchmarks.fault_rooms import make

    make(folder)
