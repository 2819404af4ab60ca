"""`evercal watch`."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from evercal.cli import main
from evercal.cli.watch import FALSE_ALARMS, Arrivals, false_alarm_share
from evercal.live import sources
from evercal.recordings import read_image, write_image

from .conftest import words_of


@pytest.fixture(scope="module")
def reference(hall_store, four_images, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("reference") / "calibration.json"
    words = ("calibrate", hall_store, four_images, "--out", out)
    assert main(words_of(words)) == 0
    return out


@pytest.fixture
def words(hall_store, reference, tmp_path) -> tuple[object, ...]:
    """A command that watches the folder `arriving`."""
    (tmp_path / "arriving").mkdir()
    options = ("--reference", reference, "--interval 0.05")
    return ("watch", hall_store, tmp_path / "arriving", *options)


def test_false_alarm_shares_sum_to_one_percent():
    tests = 100_000
    total = sum(false_alarm_share(test) for test in range(1, tests + 1))
    rest = FALSE_ALARMS * 6 / math.pi**2 / tests  # the integral of the tail
    assert total + rest == pytest.approx(0.01, rel=1e-6)


def test_no_alarm_while_the_camera_stands_still(run, words, still_images, tmp_path):
    for path in still_images.iterdir():
        (tmp_path / "arriving" / path.name).write_bytes(path.read_bytes())
    ran = run(*words, "--idle 0.3 --json")
    assert ran.code == 0
    records = [json.loads(line) for line in ran.out.splitlines()]
    assert sorted(record["image"] for record in records) == sorted(
        path.name for path in still_images.iterdir()
    )
    assert not any(record["moved"] for record in records)


def test_moved_camera_ends_the_watch_with_exit_code_1(run, words, hall, tmp_path):
    for i in range(4):
        write_image(tmp_path / "arriving" / f"{i}.png", hall.test[6].read_image())
    ran = run(*words, "--idle 20 --window 3")
    assert ran.code == 1
    assert len(ran.out.splitlines()) == 3  # one image could be an outlier
    assert "The camera has moved by" in ran.out


def test_half_written_file_is_read_when_it_is_complete(four_images, tmp_path):
    data = (four_images / "00.png").read_bytes()
    arrivals = Arrivals(tmp_path)
    path = tmp_path / "late.png"
    path.write_bytes(data[: len(data) // 2])
    assert list(arrivals.scan()) == []
    path.write_bytes(data)
    [(arrived, pixels)] = arrivals.scan()
    assert arrived == "late.png"
    np.testing.assert_array_equal(pixels, read_image(path))
    assert list(arrivals.scan()) == []


def test_a_moved_camera_is_watched_as_it_runs(run, words, hall, monkeypatch):
    class Running:
        def read(self):
            return 12.5, hall.test[6].read_image()

    monkeypatch.setattr(sources, "open_camera", lambda source: Running())
    ran = run(*words[:2], "ros2:/camera/image_raw", *words[3:], "--window 3")
    assert ran.code == 1
    assert [line.split()[1] for line in ran.out.splitlines()] == ["12.500:"] * 3


def test_broken_file_does_not_end_the_watch_nor_prolong_it(
    run, words, four_images, tmp_path
):
    folder = tmp_path / "arriving"
    (folder / "0-broken.png").write_bytes(b"\x89PNG broken")
    (folder / "1-folder.png").mkdir()
    (folder / "2-image.png").write_bytes((four_images / "00.png").read_bytes())
    ran = run(*words, "--idle 0.5 --json")
    assert ran.code == 0
    assert [json.loads(line)["image"] for line in ran.out.splitlines()] == [
        "2-image.png"
    ]
    warnings = [line for line in ran.err if line.startswith("warning: ")]
    assert [Path(line.split(": ")[1]).name for line in warnings] == [
        "0-broken.png",
        "1-folder.png",
    ]


def test_neither_one_moved_image_nor_one_of_another_shape_ends_the_watch(
    run, words, hall, tmp_path
):
    black = np.zeros((240, 320, 3), np.uint8)
    moved = hall.test[6].read_image()
    for i, image in enumerate((black, black[:200, :200], black, moved)):
        write_image(tmp_path / "arriving" / f"{i}.png", image)
    ran = run(*words, "--idle 0.5 --json")
    assert ran.code == 0
    first, second, third = map(json.loads, ran.out.splitlines())
    assert first["moved"] is second["moved"] is None
    assert first["reason"]
    assert third["moved"]
    assert "1.png: camera 320x240 does not fit the image 200x200" in "".join(ran.err)
