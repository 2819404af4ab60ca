"""`evercal refresh`: the stated camera is used, and misuse is one line."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from evercal.recordings import generic


@pytest.mark.parametrize("form", ["recording", "images"])
def test_the_stated_camera_is_used(
    run,
    hall_store,
    hall,
    tmp_path,
    monkeypatch,
    form,
):
    from evercal.errors import InputError
    from evercal.map import Map

    generic.write(tmp_path / "now", replace(hall, train=hall.train[:6], test=()))
    (tmp_path / "camera.txt").write_text("250 0 160\n0 250 120\n0 0 1\n")
    given = []

    def refresh(self: Map, images: object, *, camera: Any = None, **_: object) -> None:
        given.append(camera)
        raise InputError("seen")

    monkeypatch.setattr(Map, "refresh", refresh)
    source = tmp_path / "now" / ("" if form == "recording" else "images")
    run("refresh", hall_store, source, "--camera", tmp_path / "camera.txt")
    run("refresh", hall_store, source)
    assert given[0].fx == 250
    assert (given[0].width, given[0].height) == (320, 240)
    assert given[1] is None
    (tmp_path / "now" / "scene.json").write_text("{")
    assert "scene.json" in run("refresh", hall_store, tmp_path / "now").err[0]


def test_a_recording_without_training_frames_is_one_line(
    run, hall_store, hall, tmp_path
):
    generic.write(tmp_path / "now", replace(hall, name="now", train=()))
    ran = run("refresh", hall_store, tmp_path / "now")
    assert ran.code == 2
    assert ran.err == [
        "error: recording 'now': no training frames, which refresh a map; give a folder of its"
        " images"
    ]
