"""`import evercal` is fast and provides every public name."""

import subprocess
import sys
import time

import pytest

import evercal

HEAVY = ("torch", "cv2", "scipy", "matplotlib", "poselib", "tyro", "numpy")


def test_import_is_fast_and_loads_nothing_heavy() -> None:
    code = (
        "import sys, time; start = time.perf_counter(); import evercal;"
        " print(time.perf_counter() - start, *sys.modules)"
    )
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    seconds, *modules = done.stdout.split()
    assert not set(HEAVY) & set(modules)
    assert float(seconds) < 1.0
    assert time.perf_counter() - start < 10.0  # the interpreter itself, on a busy machine


def test_geometry_and_recordings_load_no_torch_and_no_opencv() -> None:
    code = "import sys, evercal.geometry, evercal.storage, evercal.recordings; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert not {"torch", "cv2"} & set(done.stdout.split())


def test_public_names() -> None:
    for name in dir(evercal):
        assert getattr(evercal, name) is not None
    with pytest.raises(AttributeError, match="'evercal' has no attribute 'Localiser'"):
        _ = evercal.Localiser  # pyright: ignore[reportAttributeAccessIssue]
