"""Learning and locating on a simulated device."""

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
def test_results_on_a_simulated_device_equal_those_of_the_cpu() -> None:
    """In a process of its own: the device changes torch for good."""
    checks = Path(__file__).with_name("on_simulated_device.py")
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider"]
    done = subprocess.run([*command, str(checks)], capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout[-5000:]
    assert " passed" in done.stdout
