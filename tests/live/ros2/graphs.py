"""ROS 2 graphs of processes on this machine, each in a domain of its own, on loopback alone."""

import itertools
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

LOOPBACK = (
    '<CycloneDDS><Domain id="any"><General><Interfaces><NetworkInterface name="lo"/>'
    "</Interfaces><AllowMulticast>false</AllowMulticast></General><Discovery>"
    "<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>30"
    "</MaxAutoParticipantIndex><Peers><Peer address='127.0.0.1'/></Peers>"
    "<LeaseDuration>2s</LeaseDuration></Discovery></Domain></CycloneDDS>"
)
"""Configuration of Cyclone DDS that needs no multicast."""
DRIVERS = Path(__file__).with_name("drivers.py")


_DOMAINS = itertools.count()


def environment(domain: int | None = None) -> dict[str, str]:
    """The variables of a process in a domain, by default one that was not used before."""
    if domain is None:
        worker = os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")
        domain = 40 + 20 * (int(worker) % 9) + next(_DOMAINS) % 20
    return {"ROS_DOMAIN_ID": str(domain), "CYCLONEDDS_URI": LOOPBACK}


@contextmanager
def driver(*words: object) -> Iterator[subprocess.Popen[str]]:
    """A process of `drivers.py` that publishes; it has begun when the context is entered."""
    process = subprocess.Popen(
        [sys.executable, str(DRIVERS), *map(str, words)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    with process:
        try:
            assert process.stdout.readline() == "ready\n"
            yield process
        finally:
            process.kill()


def tell(process: subprocess.Popen[str], value: float) -> None:
    """Give a driver another number."""
    assert process.stdin is not None
    process.stdin.write(f"{value}\n")
    process.stdin.flush()
