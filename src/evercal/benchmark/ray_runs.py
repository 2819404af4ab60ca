"""The runs of a benchmark on many machines, through Ray (extra `ray`)."""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from evercal.benchmark import results
from evercal.benchmark.bench import BenchOptions, Step, begin_bench, run_bench
from evercal.benchmark.results import SceneResult
from evercal.benchmark.scene_views import VIEWS
from evercal.continual.plugin import load_plugin
from evercal.datasets import Scene
from evercal.errors import InputError
from evercal.storage import write_bytes


def run_on_ray(
    scenes: Sequence[Scene],
    options: BenchOptions,
    out: Path,
    address: str,
    plugin: Path | None = None,
) -> Iterator[Step]:
    """Runs what is missing, one task per strategy and seed; see `run_bench`.

    Every task learns its first scene itself. Recordings, plugin and, where they are to be shared,
    the features must lie under the same paths on all machines.

    Args:
        scenes: two or more.
        options: what is compared.
        out: folder of results on this machine.
        address: of a running Ray cluster, or `local` to start one on this machine.
        plugin: file of strategies that the workers must know.

    Raises:
        InputError: the extra is missing, no cluster at the address, or as `run_bench`.

    Yields:
        A `Step` for every stage, run by run as they finish.
    """
    ray = _ray()
    missing = begin_bench(scenes, options, out)
    try:
        ray.init(
            address=None if address == "local" else address,
            ignore_reinit_error=True,
            log_to_driver=False,
        )
    except (ConnectionError, ValueError) as error:
        raise InputError(f"--ray {address}: no cluster there ({error})") from error
    try:
        job, given = ray.remote(_one_run), ray.put(list(scenes))
        tasks = {}
        for seed, strategy in missing:
            one = replace(options, strategies=(strategy,), seeds=(seed,))
            tasks[job.remote(given, one, plugin)] = seed, strategy
        total = len(options.seeds) * len(options.strategies) * len(scenes)
        done = total - len(missing) * len(scenes)
        while tasks:
            (ready,), _ = ray.wait(list(tasks), num_returns=1)
            seed, strategy = tasks.pop(ready)
            found, views = ray.get(ready)
            results.append(out, found)
            for name, data in views.items():
                (out / VIEWS).mkdir(exist_ok=True)
                if not (out / VIEWS / name).exists():
                    write_bytes(out / VIEWS / name, data)
            for stage in range(len(scenes)):
                done += 1
                these = tuple(o for o in found if o.stage == stage)
                yield Step(strategy.name, seed, these, done, total)
    finally:
        ray.shutdown()


def _one_run(
    scenes: list[Scene], options: BenchOptions, plugin: Path | None
) -> tuple[list[SceneResult], dict[str, bytes]]:
    """A task: one strategy, one seed, in a folder of its own; its outcomes and views."""
    if plugin is not None:
        load_plugin(plugin)
    with tempfile.TemporaryDirectory(prefix="evercal-bench-") as folder:
        for _ in run_bench(scenes, options, Path(folder)):
            pass
        views = {path.name: path.read_bytes() for path in (Path(folder) / VIEWS).iterdir()}
        return results.read(Path(folder)), views


def _ray():
    try:
        import ray  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputError("--ray needs Ray: pip install 'evercal[ray]'") from None
    return ray
