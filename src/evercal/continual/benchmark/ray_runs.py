"""The runs of a benchmark on many machines, through Ray (extra `ray`).

    OUT/runs/ray/shared               tells a worker whether it sees this folder
    OUT/runs/ray/STRATEGY-SEED/       a run under way where the disk is shared, gone when it is done

A run that fails is tried again and goes on inside its sequence, from its last checkpoint: in its
folder, or, where workers do not see the disk of this machine, from what the failed task sent back.
A worker that dies without a word on a disk of its own starts its run anew.
"""

import io
import pickle
import shutil
import sys
import tarfile
import tempfile
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from evercal.continual.benchmark import results
from evercal.continual.benchmark.bench import BenchOptions, Step, begin_bench, run_bench
from evercal.continual.benchmark.results import SceneResult
from evercal.continual.benchmark.scene_views import VIEWS
from evercal.continual.plugin import load_plugin
from evercal.continual.strategies import Strategy
from evercal.errors import InputError
from evercal.recordings import Recording
from evercal.storage import write_bytes

TRIES = 4
"""How often a run is begun or gone on with before it is given up."""


@dataclass(frozen=True)
class Job:
    """What a task needs besides the scenes."""

    strategy: str
    """Name of the strategy."""
    pickled: bytes
    """The strategy, to be read when the plugin is there: its class may be the plugin's."""
    options: BenchOptions
    """With one seed, without strategies."""
    plugin: Path | None
    """File of strategies."""
    folder: Path
    """Of this run, on the disk of the machine that started it."""
    token: str
    """What the file `shared` beside the folder holds: who reads it there sees the same disk."""
    state: bytes | None = None
    """An archive of what an earlier try had done, where the disk is not shared."""

    @property
    def name(self) -> str:
        """STRATEGY-SEED."""
        return f"{self.strategy}-{self.options.seeds[0]}"


@dataclass(frozen=True)
class Outcome:
    """What a task sends back."""

    results: tuple[SceneResult, ...] = ()
    """All of the run; none when it failed."""
    views: dict[str, bytes] | None = None
    """Files of its views."""
    error: str = ""
    """Why it failed, in one line."""
    hopeless: bool = False
    """Whether it would fail again in the same way."""
    state: bytes | None = None
    """An archive of what is done, where the disk is not shared."""


def run_on_ray(
    scenes: Sequence[Recording],
    options: BenchOptions,
    out: Path,
    address: str,
    plugin: Path | None = None,
    on_failure: Callable[[str], None] | None = None,
) -> Iterator[Step]:
    """Runs what is missing, one task per strategy and seed; see `run_bench`.

    Every task learns its first scene itself, on the CPU or on one GPU. Recordings, plugin and,
    where they are to be shared, the features must lie under the same paths on all machines.

    Args:
        scenes: two or more.
        options: what is compared; the device is that of the workers: auto, cpu or cuda.
        out: folder of results on this machine.
        address: of a running Ray cluster, or `local` to start one on this machine.
        plugin: file of strategies that the workers must know.
        on_failure: told of every failure, in a line; it goes to stderr when None.

    Raises:
        InputError: the extra is missing, no cluster at the address, as `run_bench`, or, when all
            others are done, a run that failed for good.

    Yields:
        A `Step` for every stage, run by run as they finish.
    """
    ray = _ray()
    missing = begin_bench(scenes, options, out)
    tell = on_failure or (lambda line: print(line, file=sys.stderr, flush=True))  # noqa: T201
    _join(ray, address)
    try:
        jobs = _jobs(missing, options, plugin, out)
        total = len(options.seeds) * len(options.strategies) * len(scenes)
        done = total - len(missing) * len(scenes)
        given_up: list[str] = []
        gpus = _gpus(ray, options.device)
        for job, outcome in _finished(ray, list(scenes), jobs, gpus, tell):
            if outcome.error:
                given_up.append(f"{job.name} ({outcome.error})")
                continue
            _keep(out, outcome)
            shutil.rmtree(job.folder, ignore_errors=True)
            (seed,) = job.options.seeds
            for stage in range(len(scenes)):
                done += 1
                these = tuple(o for o in outcome.results if o.stage == stage)
                yield Step(job.strategy, seed, these, done, total)
    finally:
        ray.shutdown()
    if given_up:
        raise InputError(
            f"{len(given_up)} of {len(missing)} runs failed: {'; '.join(given_up)}; the others are"
            f" in {out}, the same command tries these again"
        )


def _join(ray, address: str) -> None:
    where = None if address == "local" else address
    try:
        ray.init(address=where, ignore_reinit_error=True, log_to_driver=False)
    except (ConnectionError, ValueError) as error:
        raise InputError(f"--ray {address}: no cluster there ({error})") from error


def _gpus(ray, device: str) -> int:
    """How many GPUs a task asks for: Ray hides all of them from one that asks for none."""
    there = ray.cluster_resources().get("GPU", 0) >= 1
    if device == "cuda" and not there:
        raise InputError("device 'cuda': the cluster has no GPU; take auto or cpu")
    return int(there and device != "cpu")


def _jobs(
    missing: Sequence[tuple[int, Strategy]], options: BenchOptions, plugin: Path | None, out: Path
) -> list[Job]:
    around = out.absolute() / "runs" / "ray"
    around.mkdir(parents=True, exist_ok=True)
    token = uuid.uuid4().hex
    write_bytes(around / "shared", token.encode())
    return [
        Job(
            strategy.name,
            pickle.dumps(strategy),
            replace(options, strategies=(), seeds=(seed,)),
            plugin,
            around / f"{strategy.name}-{seed}",
            token,
        )
        for seed, strategy in missing
    ]


def _finished(
    ray, scenes: list[Recording], jobs: Sequence[Job], gpus: int, tell: Callable[[str], None]
) -> Iterator[tuple[Job, Outcome]]:
    """Jobs as they end, well or for good; what fails otherwise is tried again."""
    # Ray's own repetition would begin a run anew, unseen.
    how = {"max_retries": 0, "num_gpus": gpus}
    task, given = ray.remote(**how)(_one_run), ray.put(scenes)
    tasks = {task.remote(given, job): (job, 1) for job in jobs}
    while tasks:
        (ready,), _ = ray.wait(list(tasks), num_returns=1)
        job, tries = tasks.pop(ready)
        try:
            outcome = ray.get(ready)
        except Exception as error:  # the worker died, or was killed for its memory
            outcome = Outcome(error=_line(error))
        if outcome.error:
            last = outcome.hopeless or tries == TRIES
            what = "given up" if last else "goes on from its last checkpoint"
            tell(f"run {job.name}, try {tries} of {TRIES}: {outcome.error}; {what}")
            if not last:
                again = replace(job, state=outcome.state or job.state)
                tasks[task.remote(given, again)] = again, tries + 1
                continue
        yield job, outcome


def _one_run(scenes: list[Recording], job: Job) -> Outcome:
    """A task: one strategy, one seed, in a folder that the next try finds again."""
    with tempfile.TemporaryDirectory(prefix="evercal-bench-") as temporary:
        shared = _reads(job.folder.parent / "shared") == job.token
        folder = job.folder if shared else Path(temporary)
        folder.mkdir(exist_ok=True)
        try:
            if not shared and job.state is not None:
                with tarfile.open(fileobj=io.BytesIO(job.state)) as archive:
                    archive.extractall(folder, filter="data")
            if job.plugin is not None:
                load_plugin(job.plugin)
            options = replace(job.options, strategies=(pickle.loads(job.pickled),))
            for _ in run_bench(scenes, options, folder):
                pass
            views = {path.name: path.read_bytes() for path in (folder / VIEWS).iterdir()}
            return Outcome(tuple(results.read(folder)), views)
        except Exception as error:
            state = None if shared else _archive(folder)
            return Outcome(error=_line(error), hopeless=isinstance(error, InputError), state=state)


def _keep(out: Path, outcome: Outcome) -> None:
    results.append(out, outcome.results)
    for name, data in (outcome.views or {}).items():
        (out / VIEWS).mkdir(exist_ok=True)
        if not (out / VIEWS / name).exists():
            write_bytes(out / VIEWS / name, data)


def _archive(folder: Path) -> bytes:
    """A run under way, without the encoded views: those can be made again."""
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode="w") as archive:
        for path in sorted(folder.iterdir()):
            if path.name != "features":
                archive.add(path, path.name)
    return data.getvalue()


def _reads(path: Path) -> str | None:
    try:
        return path.read_text()
    except OSError:
        return None


def _line(error: Exception) -> str:
    """The kind of an error and the last line of what it says: Ray puts the traceback before."""
    said = str(error).strip().splitlines() or [""]
    return f"{type(error).__name__}: {said[-1].strip()}"


def _ray():
    try:
        import ray  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputError("--ray needs Ray: pip install 'evercal[ray]'") from None
    return ray
