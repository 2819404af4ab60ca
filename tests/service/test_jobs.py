"""What fails unexpectedly costs its own job or moment, not those that follow."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from evercal.map import Map
from evercal.service.jobs import Jobs
from evercal.service.learning import Request
from evercal.service.live_map import LiveMap


def test_a_job_that_fails_unexpectedly_does_not_stop_the_queue(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def learn(self: Jobs, key: str, request: Request) -> None:
        if request.name == "bad":
            raise OSError("got end of file\nduring message")
        self._set(key, status="done")

    monkeypatch.setattr(Jobs, "_learn", learn)
    jobs = Jobs(2, lambda: None)
    bad, good = (jobs.add(Request(tmp_path, tmp_path, False, name)) for name in ("bad", "good"))
    deadline = time.monotonic() + 30
    while jobs.pending:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    jobs.close()
    failed, done = jobs.get(bad.id), jobs.get(good.id)
    assert failed is not None
    assert done is not None
    assert failed.error == "internal error: got end of file during message"
    assert done.status == "done"


def test_a_map_that_cannot_be_read_for_a_moment_is_read_again(
    copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    live, opened = LiveMap(copy, "cpu"), Map.open

    def fails(*_: object, **__: object) -> Map:
        raise OSError("stale file handle")

    Map.open(copy, device="cpu").rename("hall", "lobby")
    monkeypatch.setattr(Map, "open", fails)
    live.refresh()
    assert live.current.scenes == ("hall",)
    monkeypatch.setattr(Map, "open", opened)
    assert live.refresh()
    assert live.current.scenes == ("lobby",)
    assert not live.refresh()
