"""Suites on disk: complete, reproducible, continued after an interruption; bad input is refused."""

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from evercal.errors import InputError
from evercal.recordings import load_recording
from evercal.simulation import cell
from evercal.simulation.cell import SimulateOptions, Suite, simulate
from evercal.simulation.furnished import renderer

TINY = SimulateOptions(frames=4, size=(32, 24), samples=1)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mitsuba", reason="the extra 'sim' is not installed")
    suite = Suite((("kitchen", "kitchen", 102),), 4, (32, 24), 1)
    monkeypatch.setitem(cell.SUITES, "sim", suite)
    monkeypatch.setattr(cell, "CALIBRATION_FRAMES", 2)


@pytest.mark.usefixtures("small")
def test_an_interrupted_run_continues_with_the_same_result(tmp_path: Path) -> None:
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    steps = list(simulate("sim", whole, TINY))
    assert [step.done for step in steps] == list(range(1, 11))
    run = simulate("sim", cut, TINY)
    for _ in range(3):
        next(run)
    run.close()
    with pytest.raises(InputError, match="no known scene format"):
        load_recording(cut / "kitchen")
    # An image without its depth is rendered again.
    (cut / "kitchen/depth/000001.png").unlink()
    (cut / "kitchen/images/000002.jpg").unlink()
    list(simulate("sim", cut, TINY))
    for part in ("", "calibration/fixed", "calibration/bumped", "calibration/hand"):
        a, b = load_recording(whole / "kitchen" / part), load_recording(cut / "kitchen" / part)
        assert len(a.train) + len(a.test) == (2 if part else 4)
        for x, y in zip(a.train + a.test, b.train + b.test, strict=True):
            np.testing.assert_array_equal(x.read_image(), y.read_image())
            assert x.depth is not None
            assert y.depth is not None
            assert x.depth.read_bytes() == y.depth.read_bytes()
            depth = cv2.imread(str(x.depth), cv2.IMREAD_UNCHANGED)
            assert depth is not None
            assert (depth.dtype, depth.shape) == (np.uint16, (24, 32))
            assert x.joints_rad is not None
            assert x.base_from_gripper is not None
    hand = load_recording(whole / "kitchen/calibration/hand").test
    truth = cell.hand_camera(0).matrix()
    for frame in hand:
        assert frame.base_from_gripper is not None
        assert frame.base_from_camera is not None
        camera = frame.base_from_gripper.inverse() @ frame.base_from_camera
        np.testing.assert_allclose(camera.matrix(), truth, atol=1e-9)
    with pytest.raises(InputError, match="begun with other settings"):
        next(simulate("sim", cut, SimulateOptions(frames=4, size=(32, 24), samples=2)))


@pytest.mark.usefixtures("small")
def test_a_sweep_alone_is_completed_by_a_later_run(tmp_path: Path) -> None:
    out = tmp_path / "rooms"
    steps = list(simulate("sim", out, replace(TINY, sweep_only=True)))
    assert (steps[-1].done, steps[-1].total) == (4, 4)
    assert len(load_recording(out / "kitchen").test) > 0
    assert not (out / "kitchen/calibration").exists()
    before = {path: path.read_bytes() for path in out.rglob("*.*")}
    steps = list(simulate("sim", out, TINY))
    assert (steps[-1].done, steps[-1].total) == (10, 10)
    assert {path: path.read_bytes() for path in before} == before
    for part in ("fixed", "bumped", "hand"):
        assert len(load_recording(out / "kitchen/calibration" / part).test) == 2


@pytest.mark.usefixtures("small")
def test_changed_recordings_leave_existing_files_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "rooms"
    list(simulate("sim", out, TINY))
    assert not (out / "kitchen/changed").exists()
    before = {path: path.read_bytes() for path in out.rglob("*.*")}
    monkeypatch.setitem(cell.SUITES, "sim", replace(cell.SUITES["sim"], changed=2))
    steps = list(simulate("sim", out, TINY))
    assert (steps[-1].done, steps[-1].total) == (12, 12)
    assert steps[-1].scene == out / "kitchen/changed"
    assert {path: path.read_bytes() for path in before} == before
    scene = load_recording(out / "kitchen/changed")
    assert (scene.name, len(scene.train)) == ("kitchen-changed", 0)
    assert [frame.name for frame in scene.test] == ["changed-000000", "changed-000001"]
    for frame in scene.test:
        assert frame.read_image().shape == (24, 32, 3)
        assert frame.depth is not None
        assert frame.depth.exists()


@pytest.mark.usefixtures("small")
def test_existing_frames_need_no_disk_space(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame = 32 * 24 * 4
    run = simulate("sim", tmp_path / "rooms", TINY)
    for _ in range(3):
        next(run)
    run.close()
    usage = cell.shutil.disk_usage(tmp_path)
    for free, is_enough in ((7 * frame, True), (7 * frame - 1, False)):
        remaining = usage._replace(free=free)
        monkeypatch.setattr(cell.shutil, "disk_usage", lambda _, usage=remaining: usage)
        if is_enough:
            assert next(simulate("sim", tmp_path / "rooms", TINY)).done == 1
        else:
            with pytest.raises(InputError, match="GB are free"):
                next(simulate("sim", tmp_path / "rooms", TINY))


def test_bad_input_is_refused(tmp_path: Path) -> None:
    for name, options, message in (
        ("lab", TINY, "use one of sim, sim-7, sim-12, sim-mini"),
        ("sim", SimulateOptions(seed=9000), "reserved"),
        ("sim", SimulateOptions(frames=10**9), r"GB are free"),
        ("sim", SimulateOptions(frames=1), "at least 2"),
        ("sim", SimulateOptions(size=(4, 4)), "at least 16x16"),
        ("sim", SimulateOptions(samples=0), "samples 0: at least 1"),
        ("sim", SimulateOptions(blur_steps=0), "blur steps 0: at least 1"),
        ("sim", SimulateOptions(noise=float("nan")), "noise nan: at least 0"),
    ):
        with pytest.raises(InputError, match=message):
            next(simulate(name, tmp_path / "out", options))
    assert not (tmp_path / "out").exists()


def test_a_missing_extra_is_named_in_the_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    renderer.mitsuba.cache_clear()
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(InputError, match=r"pip install 'evercal\[sim\]'"):
        next(simulate("sim", tmp_path / "out", TINY))
    renderer.mitsuba.cache_clear()
