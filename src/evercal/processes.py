"""Processes that evercal starts.

Python puts the current folder first on a child's import path, where a recording may lie that holds
any file. So every child is started here, with `-P` or `PYTHONSAFEPATH`.
"""

import math
import multiprocessing
import os
import shlex
import signal
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnContext
from multiprocessing.process import parent_process
from pathlib import Path
from typing import Any

_COUNTS = ("OMP_NUM_THREADS", "PYTHON_CPU_COUNT")
"""Variables that bound the number of threads."""
_DIGITS = 10
"""Digits of a number that no longer bounds anything."""
_CGROUPS = Path("/sys/fs/cgroup")
"""Files of the groups of processes; in a container, those of its own."""
_PROC = Path("/proc")
"""Files of processes."""


@contextmanager
def started_safely(variables: Mapping[str, str] = {}) -> Iterator[SpawnContext]:
    """The context for starting processes; those started meanwhile inherit the variables."""
    variables = {"PYTHONSAFEPATH": "1", **variables}
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        # Threads of libraries do not survive a fork.
        yield multiprocessing.get_context("spawn")
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def cores() -> int:
    """Processor cores that this process may use, at least 1.

    Its affinity, the quota of its container and the variables in `_COUNTS` bound them.
    """
    counts = [os.cpu_count() or 1, *_quotas()]
    if sys.platform == "linux":
        counts.append(len(os.sched_getaffinity(0)))
    for name in _COUNTS:
        count = os.environ.get(name, "")
        if count.isdecimal() and len(count) < _DIGITS:
            counts.append(int(count))
    return min(filter(None, counts))


def _quotas() -> Iterator[int]:
    """Processors' time that cgroups (version 2) grant: of this process, and of those above it."""
    with suppress(OSError, ValueError):
        own = (_PROC / "self/cgroup").read_text("utf-8").partition("0::/")[2]
        folder = _CGROUPS / own.partition("\n")[0]
        for group in (folder, *folder.parents):
            file = group / "cpu.max"
            if file.exists():
                quota, period = file.read_text("utf-8").split()
                if quota != "max":
                    yield math.ceil(int(quota) / int(period))


_pools: Any = None
"""The controller of the thread pools of BLAS; None before its first use."""
_limiting = 0
"""Contexts of `one_product_thread` that are open."""
_limits = threading.Lock()
"""Guards both."""


@contextmanager
def one_product_thread() -> Iterator[None]:
    """Calculate matrix products with one thread meanwhile, in the whole process.

    The matrices of an image are so small that threads mostly wait for each other: on a busy machine
    an image takes ten times as long with two.
    """
    global _pools, _limiting
    with _limits:
        if _limiting == 0:
            from threadpoolctl import ThreadpoolController

            _pools = _pools or ThreadpoolController()
            _pools.before = _pools.limit(limits=1, user_api="blas")
        _limiting += 1
    try:
        yield
    finally:
        with _limits:
            _limiting -= 1
            if _limiting == 0:
                _pools.before.restore_original_limits()


def python_command(*words: str) -> list[str]:
    """The command that runs this Python."""
    return [sys.executable, "-P", *words]


def command_line(words: Iterable[str]) -> str:
    """Words of a command as the shells of this system read them."""
    if sys.platform == "win32":
        return subprocess.list2cmdline(words)
    return shlex.join(words)


def status_of(
    code: str, *words: str, seconds: float, environment: Mapping[str, str] | None = None
) -> int | None:
    """Exit status of Python code in a process of its own; None if it does not end in time.

    The time begins when the code prints a line, after its imports.
    """
    command = python_command("-c", code, *words)
    pipe = subprocess.PIPE
    with subprocess.Popen(
        command, stdout=pipe, stderr=subprocess.DEVNULL, env=environment
    ) as process:
        assert process.stdout is not None, "it is a pipe"
        process.stdout.readline()
        try:
            return process.wait(seconds)
        except subprocess.TimeoutExpired:
            process.kill()
            return None


def output_of(*command: str) -> str:
    """What a program prints; OSError if it is missing or fails."""
    try:
        done = subprocess.run(
            command, check=True, capture_output=True, encoding="utf-8"
        )
    except subprocess.CalledProcessError as error:
        raise OSError(error.returncode, error.stderr) from None
    return done.stdout.strip()


class Worker:
    """A process that answers one request at a time; it ends with this process.

    Args:
        begin: Called in the process with `state`; returns the function that answers requests.
        state: Copied to the process.
        variables: Variables of the process.
    """

    def __init__(
        self,
        begin: Callable[[Any], Callable[[Any], Any]],
        state: object,
        variables: Mapping[str, str] = {},
    ):
        with started_safely(variables) as context:
            self.answers, theirs = context.Pipe()
            self._process = context.Process(
                target=_work, args=(theirs, begin), daemon=True
            )
            self._process.start()
        theirs.close()  # so that the end of the process ends the pipe
        # Not an argument: `start` would wait for ever if the process ended before it read it all.
        self.ask(state)

    def ask(self, request: object) -> None:
        """Send a request; `answer` states if the process has ended."""
        with suppress(OSError):
            self.answers.send(request)

    def answer(self) -> Any:
        """The answer, or EOFError if the process has ended; its exceptions are raised here."""
        try:
            answer = self.answers.recv()
        except OSError:
            raise EOFError from None
        if isinstance(answer, Exception):
            raise answer
        return answer

    def end(self, patience_s: float = 0.0) -> int:
        """End the process, and return its exit status, or minus the signal that ended it."""
        self.answers.close()
        self._process.join(patience_s)
        self._process.terminate()
        self._process.join()
        status = self._process.exitcode
        assert status is not None, "it has been joined"
        return status


def first_answers(workers: list[Worker]) -> list[Worker]:
    """The workers that have answered or ended; waits for the first."""
    ready = wait([worker.answers for worker in workers])
    return [worker for worker in workers if worker.answers in ready]


def cause_of(status: int, times: int = 1) -> str:
    """Why processes ended, in words."""
    if status >= 0:
        cause = f"its process ended with status {status}, see the lines above"
        if status == 1:  # of an exception
            cause += "; a script starts workers below 'if __name__ == \"__main__\":'"
        return cause
    name = signal.Signals(-status).name
    cause = f"its process was killed by {name}"
    if times > 1:
        cause = f"its process was killed {times} times by {name}"
    if name == "SIGKILL":
        cause += "; is there enough memory?"
    return cause


def _work(pipe: Connection, begin: Callable[[Any], Callable[[Any], Any]]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # its parent ends it
    threading.Thread(target=_end_with_parent, daemon=True).start()
    work = begin(pipe.recv())
    while True:
        try:
            request = pipe.recv()
        except EOFError:
            return
        try:
            answer = work(request)
        except Exception as error:
            error.add_note(traceback.format_exc())
            answer = error
        pipe.send(answer)


def _end_with_parent() -> None:
    parent = parent_process()
    assert parent, "called in a process that multiprocessing started"
    parent.join()
    os._exit(1)
