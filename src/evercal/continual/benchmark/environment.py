"""Where a result was measured: commit, versions, processor."""

import platform
from functools import cache
from importlib.metadata import version
from pathlib import Path

from evercal.processes import output_of


@cache
def environment() -> dict[str, str]:
    """Describe code, libraries and machine of this process.

    The commit has `-dirty` for changed files; for an installed package it is the version.
    """
    import numpy as np
    import torch

    from evercal.continual.networks.precision import BFLOAT16, FLOAT32, fast_bfloat16

    gpu = "none"
    device = "cpu"
    if torch.cuda.is_available():
        gpu = torch.cuda.get_device_name()
        device = "cuda"
    precision = FLOAT32
    if fast_bfloat16(device):
        precision = BFLOAT16
    return {
        "commit": _commit(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": np.__version__,
        "processor": _processor(),
        "precision": precision,
        "threads": str(torch.get_num_threads()),
        "gpu": gpu,
    }


def _commit() -> str:
    def git(*words: str) -> str:
        return output_of("git", "-C", str(Path(__file__).parent), *words)

    try:
        if not git("ls-files", Path(__file__).name):
            raise FileNotFoundError(__file__)
        commit = git("rev-parse", "HEAD")[:12]
        if git("diff", "HEAD"):
            commit += "-dirty"
        return commit
    except OSError:
        return f"evercal {version('evercal')}"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line for line in lines if line.startswith("model name")]
    if not names:
        return platform.machine()
    _, _, name = names[0].partition(":")
    return f"{len(names)} x {name.strip()}"
