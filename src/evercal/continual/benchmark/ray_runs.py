"""Runs of a benchmark on many machines, through Ray (extra `ray`).

The folder of results lies on a disk that all machines share. A failed run is retried after its last
stage, on any machine.

    OUT/runs/shared    lets a worker check that it sees the folder
"""

import pickle
import sys
import uuid
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from evercal.continual.benchmark import results
from evercal.continual.benchmark.bench import BenchOptions, Step, begin_bench, run_bench
from evercal.continual.strategies import load_plugin
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
    """The strategy, unpickled after the plugin that may define its class."""
    options: BenchOptions
    """Options with one seed and no strategies."""
    plugin: Path | None
    """Python file of further strategies."""
    out: Path
    """Folder of results."""
    token: str
    """Content of the file `shared`."""

    @property
    def name(self) -> str:
        """STRATEGY-SEED."""
        return f"{self.strategy}-{self.options.seeds[0]}"


def run_on_ray(
    scenes: Sequence[Recording],
    options: BenchOptions,
    out: Path,
    address: str,
    plugin: Path | None = None,
) -> Iterator[Step]:
    """Run all runs that are not complete, one task per strategy and seed; see `run_bench`.

    Results, recordings and plugin must lie under the same paths on all machines.

    Args:
        scenes: See `run_bench`.
        options: Options of the benchmark; `device` is that of the workers: auto, cpu or cuda.
        out: Folder of results.
        address: Address of a running Ray cluster, or `local` to start one on this machine.
        plugin: Python file of further strategies, loaded by the workers.

    Yields:
        A `Step` for every stage, run by run as they finish.
    """
    ray = _joined(address)
    try:
        missing = begin_bench(scenes, options, out)
        token = uuid.uuid4().hex
        (out / "runs").mkdir(exist_ok=True)
        write_bytes(out / "runs" / "shared", token.encode())
        jobs = [
            Job(
                strategy=strategy.name,
                pickled=pickle.dumps(strategy),
                options=replace(options, strategies=(), seeds=(seed,)),
                plugin=plugin,
                out=out.absolute(),
                token=token,
            )
            for seed, strategy in missing
        ]
        total = len(options.seeds) * len(options.strategies) * len(scenes)
        done = total - len(missing) * len(scenes)
        failed: list[str] = []
        for job, error in _finished(ray, list(scenes), jobs, _gpus(ray, options.device)):
            if error:
                failed.append(f"{job.name} ({error})")
                continue
            (seed,) = job.options.seeds
            rows = results.run_of(results.read(out), job.strategy, seed)
            for stage in range(len(scenes)):
                done += 1
                yield Step(job.strategy, seed, rows[rows["stage"] == stage], done, total)
    finally:
        ray.shutdown()
    if failed:
        raise InputError(
            f"{len(failed)} of {len(missing)} runs failed: {'; '.join(failed)}; the others are in"
            f" {out}; the same command retries the failed ones"
        )


def _gpus(ray, device: str) -> int:
    available = ray.cluster_resources().get("GPU", 0) >= 1
    if device == "cuda" and not available:
        raise InputError("device 'cuda': the cluster has no GPU; use auto or cpu")
    return int(available and device != "cpu")


def _finished(
    ray, scenes: list[Recording], jobs: Sequence[Job], gpus: int
) -> Iterator[tuple[Job, str]]:
    """Yield jobs with their final error, empty after success; other failures are retried."""
    # Ray's own retries would not be reported.
    task = ray.remote(max_retries=0, num_gpus=gpus)(_one_run)
    shared_scenes = ray.put(scenes)
    tasks = {task.remote(shared_scenes, job): (job, 1) for job in jobs}
    while tasks:
        (ready,), _ = ray.wait(list(tasks), num_returns=1)
        job, tries = tasks.pop(ready)
        try:
            error, permanent = ray.get(ready)
        except Exception as crash:  # the worker died, or was killed for its memory
            error, permanent = _line(crash), False
        if error:
            final = permanent or tries == TRIES
            action = "given up" if final else "resuming after its last stage"
            text = f"run {job.name}, attempt {tries} of {TRIES}: {error}; {action}"
            print(text, file=sys.stderr, flush=True)  # noqa: T201
            if not final:
                tasks[task.remote(shared_scenes, job)] = job, tries + 1
                continue
        yield job, error


def _one_run(scenes: list[Recording], job: Job) -> tuple[str, bool]:
    """Run one strategy with one seed; this is the Ray task.

    Returns:
        The error in one line, empty after success, and whether a retry would fail alike.
    """
    try:
        token = job.out / "runs" / "shared"
        if not token.is_file() or token.read_text() != job.token:
            raise InputError(f"a worker does not see {job.out}; give --out on a shared disk")
        if job.plugin is not None:
            load_plugin(job.plugin)
        options = replace(job.options, strategies=(pickle.loads(job.pickled),))
        for _ in run_bench(scenes, options, job.out):
            pass
    except Exception as error:
        return _line(error), isinstance(error, InputError)
    return "", False


def _line(error: Exception) -> str:
    lines = str(error).strip().splitlines() or [""]
    return f"{type(error).__name__}: {lines[-1].strip()}"


def _joined(address: str):
    try:
        import ray  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputError("--ray needs Ray: pip install 'ray>=2.50'") from None
    cluster = None if address == "local" else address
    try:
        ray.init(address=cluster, ignore_reinit_error=True, log_to_driver=False)
    except (ConnectionError, ValueError) as error:
        raise InputError(f"--ray {address}: no cluster at this address ({error})") from error
    return ray
