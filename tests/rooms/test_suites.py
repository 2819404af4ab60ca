"""Suites on disk: complete, reproducible, continued after an interruption; bad input is refused."""

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from evercal.errors import InputError
from evercal.recordings import load_recording
from rooms import renderer, suites
from rooms.__main__ import main
from rooms.paths import hand_camera
from rooms.suites import SimulateOptions, Suite, simulate

pytestmark = pytest.mark.slow("rooms", "src/evercal/simulation")

TINY = SimulateOptions(frames=4, size=(32, 24), samples=1)
SUITE = Suite((("kitchen", "kitchen", 102),), 4, (32, 24), 1, changed=2)
PARTS = {
    "": 4,
    "changed": 2,
    **{f"calibration/{name}": 2 for name in ("fixed", "bumped", "hand")},
}
"""Frames of each recording."""


@pytest.fixture(scope="module", autouse=True)
def small() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(suites.SUITES, "sim", SUITE)
        patch.setattr(suites, "CALIBRATION_FRAMES", 2)
        yield


@pytest.fixture(scope="module")
def whole(small: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A suite rendered in one run."""
    pytest.importorskip("mitsuba", reason="Mitsuba is not installed")
    out = tmp_path_factory.mktemp("suite") / "whole"
    assert [step.done for step in simulate("sim", out, TINY)] == list(range(1, 13))
    return out


def contents(out: Path) -> dict[str, bytes]:
    return {str(path.relative_to(out)): path.read_bytes() for path in out.rglob("*.*")}


def test_recordings_have_images_depth_and_poses_of_the_arm(whole: Path) -> None:
    for part, count in PARTS.items():
        scene = load_recording(whole / "kitchen" / part)
        frames = scene.train + scene.test
        assert len(frames) == count
        for frame in frames:
            assert frame.read_image().shape == (24, 32, 3)
            depth = cv2.imread(str(frame.depth), cv2.IMREAD_UNCHANGED)
            assert depth is not None
            assert (depth.dtype, depth.shape) == (np.uint16, (24, 32))
            assert frame.joints_rad is not None
    changed = load_recording(whole / "kitchen/changed")
    assert (changed.name, len(changed.train)) == ("kitchen-changed", 0)
    for frame in load_recording(whole / "kitchen/calibration/hand").test:
        assert frame.base_from_gripper is not None
        assert frame.base_from_camera is not None
        camera = frame.base_from_gripper.inverse() @ frame.base_from_camera
        np.testing.assert_allclose(camera.matrix(), hand_camera(0).matrix(), atol=1e-9)


def test_interrupted_runs_continue_with_the_same_result(
    whole: Path, tmp_path: Path
) -> None:
    cut = tmp_path / "cut"
    run = simulate("sim", cut, replace(TINY, sweep_only=True))
    for _ in range(3):
        next(run)
    run.close()
    with pytest.raises(InputError, match=r"3 images in .* without poses"):
        load_recording(cut / "kitchen")
    # An image without its depth is rendered again.
    (cut / "kitchen/depth/000001.png").unlink()
    (cut / "kitchen/images/000002.jpg").unlink()
    steps = list(simulate("sim", cut, replace(TINY, sweep_only=True)))
    assert (steps[-1].done, steps[-1].total) == (4, 4)
    assert not (cut / "kitchen/calibration").exists()
    steps = list(simulate("sim", cut, TINY))
    assert (steps[-1].done, steps[-1].total) == (12, 12)
    assert contents(cut) == contents(whole)


def test_a_finished_suite_is_not_rendered_again(
    whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.stat().st_mtime_ns for path in whole.rglob("*.jpg")}
    words = ["sim", "--out", str(whole), "--size", "32", "24", "--samples", "1"]
    assert main([*words, "--frames", "4"]) == 0
    assert capsys.readouterr().out == f"next: evercal inspect {whole / 'kitchen'}\n"
    assert {path: path.stat().st_mtime_ns for path in whole.rglob("*.jpg")} == before
    assert main([*words, "--frames", "4", "--seed", "1"]) == 2
    assert "seed 0, now it is 1" in capsys.readouterr().err


def test_existing_frames_need_no_disk_space(
    whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame = 32 * 24 * 4
    usage = suites.shutil.disk_usage(whole)._replace(free=3 * frame)
    monkeypatch.setattr(suites.shutil, "disk_usage", lambda _: usage)
    with pytest.raises(InputError, match="begun with other settings"):
        next(simulate("sim", whole, replace(TINY, frames=7)))
    with pytest.raises(InputError, match="GB are free"):
        next(simulate("sim", whole, replace(TINY, frames=8)))


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


def test_a_missing_renderer_is_named_in_the_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    renderer.mitsuba.cache_clear()
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(InputError, match=r"pip install -c constraints\.txt mitsuba"):
        next(simulate("sim", tmp_path / "out", TINY))
    renderer.mitsuba.cache_clear()
