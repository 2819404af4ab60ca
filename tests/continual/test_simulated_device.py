"""Learning, resuming and locating on a simulated device."""

import subprocess
import sys
from pathlib import Path

import pytest

FEW = "refused or map_is_built or finetune or gem-code or sars_spdd-descriptor or co2l"


@pytest.mark.parametrize("chosen", [FEW, pytest.param("", marks=pytest.mark.slow)])
def test_results_on_a_simulated_device_equal_those_of_the_cpu(chosen: str) -> None:
    """In a process of its own: the device changes torch for good."""
    checks = Path(__file__).with_name("on_simulated_device.py")
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider"]
    done = subprocess.run(
        [*command, "-k", chosen, str(checks)], capture_output=True, text=True, timeout=900
    )
    assert done.returncode == 0, done.stdout[-5000:]
    assert " passed" in done.stdout
