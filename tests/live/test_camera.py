"""Images of sources in order, and the newest image of a live one."""

import threading
import time

import numpy as np
import pytest

from evercal.errors import InputError
from evercal.live import camera
from evercal.live.camera import StreamCamera
from evercal.recordings.images import write_image
from evercal.recordings.streams import StreamFrame


def picture(value):
    return np.full((8, 8, 3), value, np.uint8)


def frame_of(value, stamp_s=None):
    now = stamp_s or time.time()
    return StreamFrame(str(value), now, picture(value), time.monotonic())


def test_a_folder_gives_its_images_in_order(tmp_path):
    for i in range(3):
        write_image(tmp_path / f"{i}.png", picture(50 * i))
    with StreamCamera(str(tmp_path), rate=10) as source:
        for i in range(3):
            stamp, image = source.read()
            assert (stamp, image[0, 0, 0]) == pytest.approx((i / 10, 50 * i))
        with pytest.raises(InputError, match="no more frames"):
            source.read()


def test_a_live_image_is_not_older_than_the_call(monkeypatch):
    closed = []

    def frames(source, rate):
        try:
            for i in range(400):
                yield frame_of(i % 250)
                time.sleep(0.005)
        finally:
            closed.append(source)

    monkeypatch.setattr(camera, "stream", frames)
    with StreamCamera("0") as source:
        for _ in range(2):
            time.sleep(0.05)
            before = time.time()
            assert source.read()[0] >= before
    assert closed == ["0"]


def test_an_image_from_before_the_call_is_not_given_after_the_clock_steps_back(
    monkeypatch,
):
    waiting = threading.Event()

    def frames(source, rate):
        yield frame_of(0, time.time() + 3600)
        waiting.set()
        time.sleep(0.1)
        yield frame_of(1)

    monkeypatch.setattr(camera, "stream", frames)
    with StreamCamera("0") as source:
        assert waiting.wait(5)
        assert int(source.read()[1][0, 0, 0]) == 1


def test_a_live_source_that_stops_or_fails_says_so(monkeypatch):
    monkeypatch.setattr(camera, "stream", lambda source, rate: iter(()))
    with (
        StreamCamera("rtsp://cell") as source,
        pytest.raises(InputError, match="rtsp://cell"),
    ):
        source.read()

    def unplugged(source, rate):
        raise InputError("unplugged")
        yield

    monkeypatch.setattr(camera, "stream", unplugged)
    with StreamCamera("0") as source, pytest.raises(InputError, match="unplugged"):
        source.read()
