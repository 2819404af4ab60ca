"""Recordings that wait to be learned, one after the other, each in a new process."""

import logging
import multiprocessing
import queue
import secrets
import shutil
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from multiprocessing.process import BaseProcess
from typing import Any, Literal

from evercal.service.learning import DONE, FAILED, Request, run

_KEPT = 200
"""Finished jobs that are remembered."""


class QueueFullError(Exception):
    """Too many requests wait; status 429."""


@dataclass(frozen=True)
class Job:
    """State of a job."""

    id: str
    status: Literal["queued", "learning", "done", "failed"] = "queued"
    name: str | None = None
    """Name of the scene, if it was given."""
    step: str = ""
    """Step that is under way, with how much of it is done and its total."""
    done: int = 0
    total: int = 0
    report: dict[str, Any] | None = None
    """`evercal learn --json`, when it is done."""
    error: str = ""
    """One line, if it failed."""

    def to_dict(self) -> dict[str, Any]:
        """JSON values."""
        return asdict(self)


class Jobs:
    """A queue of jobs and the thread that works on it.

    Args:
        most: Jobs that wait, at most.
        on_done: Called when a scene was learned, before its job is `done`.
    """

    def __init__(self, most: int, on_done: Callable[[], object]):
        self._waiting: queue.Queue[tuple[str, Request] | None] = queue.Queue(most)
        self._jobs: dict[str, Job] = {}
        self._on_done = on_done
        self._process: BaseProcess | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="jobs", daemon=True)
        self._thread.start()

    def add(self, request: Request) -> Job:
        """Queue a recording.

        Raises:
            QueueFullError: Too many are waiting.
        """
        job = Job(secrets.token_hex(8), name=request.name)
        self._jobs[job.id] = job
        try:
            self._waiting.put_nowait((job.id, request))
        except queue.Full:
            del self._jobs[job.id]
            raise QueueFullError(f"{self._waiting.maxsize} recordings wait; try again") from None
        return job

    def get(self, key: str) -> Job | None:
        """A job by its id."""
        return self._jobs.get(key)

    @property
    def pending(self) -> list[Job]:
        """Jobs that are not finished."""
        return [j for j in list(self._jobs.values()) if j.status in ("queued", "learning")]

    def close(self) -> None:
        """End the process at work and forget the queue; the map keeps its last complete state."""
        self._closed = True
        process = self._process
        if process is not None:
            process.kill()
        while True:
            try:
                self._drop(self._waiting.get_nowait())
            except queue.Empty:
                break
        self._waiting.put(None)
        self._thread.join()

    def _work(self) -> None:
        while (item := self._waiting.get()) is not None:
            key, request = item
            if self._closed:
                self._drop(item)
                continue
            try:
                self._learn(key, request)
            except Exception as error:  # the jobs that wait do not fail with it
                logging.getLogger(__name__).exception("job %s", key)
                self._set(key, status=FAILED, error=" ".join(f"internal error: {error}".split()))
            finally:
                self._drop(item)
            jobs = list(self._jobs.items())
            finished = [k for k, j in jobs if j.status in ("done", "failed")]
            for old in finished[:-_KEPT]:
                del self._jobs[old]

    @staticmethod
    def _drop(item: tuple[str, Request] | None) -> None:
        if item is not None and item[1].is_archive:
            item[1].recording.unlink(missing_ok=True)
            shutil.rmtree(item[1].extracted, ignore_errors=True)

    def _learn(self, key: str, request: Request) -> None:
        context = multiprocessing.get_context("spawn")  # threads of torch do not survive a fork
        out, back = context.Pipe(duplex=False)
        process = context.Process(target=run, args=(request, back), daemon=True)
        process.start()
        self._process = process
        if self._closed:
            process.kill()
        back.close()
        outcome: tuple[str, Any] = FAILED, "the process that learned it was ended"
        self._set(key, status="learning")
        try:
            while True:
                kind, content = out.recv()
                if kind in (DONE, FAILED):
                    outcome = kind, content
                    break
                step, done, total = content
                self._set(key, step=step, done=done, total=total)
        except (EOFError, OSError):  # it was killed, perhaps in the middle of a message
            pass
        process.join()
        self._process = None
        if outcome[0] == DONE:
            self._on_done()
            self._set(key, status=DONE, name=outcome[1]["scene"], report=outcome[1])
        else:
            self._set(key, status=FAILED, error=" ".join(str(outcome[1]).split()))

    def _set(self, key: str, **values: Any) -> None:
        self._jobs[key] = replace(self._jobs[key], **values)
