"""Runs of a benchmark on many machines, through Ray (extra `ray`).

    OUT/runs/ray/shared               lets a worker check whether it shares this disk
    OUT/runs/ray/STRATEGY-SEED/       run in progress on a shared disk, removed when complete

A failed run is retried from its last checkpoint. The checkpoint lies in the folder of the run or,
if workers do not share the disk, in an archive that the failed task returns. If a worker with its
own disk dies, its run starts again.
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
"""Attempts before a run is given up."""


@dataclass(frozen=True)
class Job:
    """Input of a task, besides the scenes."""

    strategy: str
    """Name of the strategy."""
    pickled: bytes
    """The strategy. It is unpickled after the plugin is loaded, which may define its class."""
    options: BenchOptions
    """Options with one seed and no strategies."""
    plugin: Path | None
    """Python file of further strategies."""
    folder: Path
    """Folder of the run on the disk of the machine that started it."""
    token: str
    """Content of the file `shared` beside the folder; a worker that reads it shares the disk."""
    state: bytes | None = None
    """Archive of an earlier attempt, if the disk is not shared."""

    @property
    def name(self) -> str:
        """STRATEGY-SEED."""
        return f"{self.strategy}-{self.options.seeds[0]}"


@dataclass(frozen=True)
class Outcome:
    """Output of a task."""

    results: tuple[SceneResult, ...] = ()
    """All results of the run; empty if it failed."""
    views: dict[str, bytes] | None = None
    """Contents of its view files, by name."""
    environments: dict[str, dict[str, str]] | None = None
    """Where the results were measured, by key."""
    error: str = ""
    """Cause of the failure, in one line."""
    permanent: bool = False
    """Whether a retry would fail in the same way."""
    state: bytes | None = None
    """Archive of the run in progress, if the disk is not shared."""


def run_on_ray(
    scenes: Sequence[Recording],
    options: BenchOptions,
    out: Path,
    address: str,
    plugin: Path | None = None,
    on_failure: Callable[[str], None] | None = None,
) -> Iterator[Step]:
    """Run all runs that are not complete, one task per strategy and seed; see `run_bench`.

    Every task learns its first scene itself, on the CPU or on one GPU. Recordings, plugin and
    shared features must lie under the same paths on all machines.

    Args:
        scenes: Two or more scenes.
        options: Options of the benchmark; `device` is that of the workers: auto, cpu or cuda.
        out: Folder of results on this machine.
        address: Address of a running Ray cluster, or `local` to start one on this machine.
        plugin: Python file of further strategies, loaded by the workers.
        on_failure: Called with a line about every failure. Defaults to printing on stderr.

    Raises:
        InputError: The extra is missing, there is no cluster at the address, as `run_bench`, or,
            after all other runs, a run failed permanently.

    Yields:
        A `Step` for every stage, run by run as they finish.
    """
    ray = _ray()
    missing = begin_bench(scenes, options, out)
    report = on_failure or (lambda line: print(line, file=sys.stderr, flush=True))  # noqa: T201
    _join(ray, address)
    try:
        jobs = _jobs(missing, options, plugin, out)
        total = len(options.seeds) * len(options.strategies) * len(scenes)
        done = total - len(missing) * len(scenes)
        failed: list[str] = []
        gpus = _gpus(ray, options.device)
        for job, outcome in _finished(ray, list(scenes), jobs, gpus, report):
            if outcome.error:
                failed.append(f"{job.name} ({outcome.error})")
                continue
            _store(out, outcome)
            shutil.rmtree(job.folder, ignore_errors=True)
            (seed,) = job.options.seeds
            for stage in range(len(scenes)):
                done += 1
                these = tuple(r for r in outcome.results if r.stage == stage)
                yield Step(job.strategy, seed, these, done, total)
    finally:
        ray.shutdown()
    if failed:
        raise InputError(
            f"{len(failed)} of {len(missing)} runs failed: {'; '.join(failed)}; the others are in"
            f" {out}; the same command retries the failed ones"
        )


def _join(ray, address: str) -> None:
    cluster = None if address == "local" else address
    try:
        ray.init(address=cluster, ignore_reinit_error=True, log_to_driver=False)
    except (ConnectionError, ValueError) as error:
        raise InputError(f"--ray {address}: no cluster at this address ({error})") from error


def _gpus(ray, device: str) -> int:
    """Return the GPUs a task requests. Ray hides all GPUs from a task that requests none."""
    available = ray.cluster_resources().get("GPU", 0) >= 1
    if device == "cuda" and not available:
        raise InputError("device 'cuda': the cluster has no GPU; use auto or cpu")
    return int(available and device != "cpu")


def _jobs(
    missing: Sequence[tuple[int, Strategy]], options: BenchOptions, plugin: Path | None, out: Path
) -> list[Job]:
    folder, token = out.absolute() / "runs" / "ray", uuid.uuid4().hex
    folder.mkdir(parents=True, exist_ok=True)
    write_bytes(folder / "shared", token.encode())
    return [
        Job(
            strategy=strategy.name,
            pickled=pickle.dumps(strategy),
            options=replace(options, strategies=(), seeds=(seed,)),
            plugin=plugin,
            folder=folder / f"{strategy.name}-{seed}",
            token=token,
        )
        for seed, strategy in missing
    ]


def _finished(
    ray, scenes: list[Recording], jobs: Sequence[Job], gpus: int, report: Callable[[str], None]
) -> Iterator[tuple[Job, Outcome]]:
    """Yield jobs as they succeed or fail permanently; other failures are retried."""
    # Ray's own retries would not resume from a checkpoint.
    task = ray.remote(max_retries=0, num_gpus=gpus)(_one_run)
    shared_scenes = ray.put(scenes)
    tasks = {task.remote(shared_scenes, job): (job, 1) for job in jobs}
    while tasks:
        (ready,), _ = ray.wait(list(tasks), num_returns=1)
        job, tries = tasks.pop(ready)
        try:
            outcome = ray.get(ready)
        except Exception as error:  # the worker died, or was killed for its memory
            outcome = Outcome(error=_line(error))
        if outcome.error:
            final = outcome.permanent or tries == TRIES
            action = "given up" if final else "resuming from its last checkpoint"
            report(f"run {job.name}, attempt {tries} of {TRIES}: {outcome.error}; {action}")
            if not final:
                retry = replace(job, state=outcome.state or job.state)
                tasks[task.remote(shared_scenes, retry)] = retry, tries + 1
                continue
        yield job, outcome


def _one_run(scenes: list[Recording], job: Job) -> Outcome:
    """Run one strategy with one seed; this is the Ray task."""
    with tempfile.TemporaryDirectory(prefix="evercal-bench-") as temporary:
        token = job.folder.parent / "shared"
        shared = token.is_file() and token.read_text() == job.token
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
            measured_on = results.read_environments(folder)
            return Outcome(tuple(results.read(folder)), views, measured_on)
        except Exception as error:
            state = None if shared else _archive(folder)
            permanent = isinstance(error, InputError)
            return Outcome(error=_line(error), permanent=permanent, state=state)


def _store(out: Path, outcome: Outcome) -> None:
    results.append(out, outcome.results)
    results.add_environments(out, outcome.environments or {})
    (out / VIEWS).mkdir(exist_ok=True)
    for name, data in (outcome.views or {}).items():
        if not (out / VIEWS / name).exists():
            write_bytes(out / VIEWS / name, data)


def _archive(folder: Path) -> bytes:
    """Pack a run in progress, without the encoded views, which can be computed again."""
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode="w") as archive:
        for path in sorted(folder.iterdir()):
            if path.name != "features":
                archive.add(path, path.name)
    return data.getvalue()


def _line(error: Exception) -> str:
    """Return type and last line of an error; Ray puts the traceback before it."""
    lines = str(error).strip().splitlines() or [""]
    return f"{type(error).__name__}: {lines[-1].strip()}"


def _ray():
    try:
        import ray  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputError("--ray needs Ray: pip install 'evercal[ray]'") from None
    return ray
