"""Serve a map; locate an image, calibrate a fixed camera and check it over HTTP.

    python examples/08_http.py [MAP]

A missing map (default: cell.evercal) is learned from the packaged robot cell. Needs `serve`.
"""

import json
import subprocess
import sys
from pathlib import Path

import evercal
from evercal.recordings.samples import CELL


def main(path: Path) -> None:
    """Serve the map in another process, and ask it."""
    cell = evercal.Map.open(path)
    if not cell.scenes:
        cell.learn(CELL / "wrist")
    command = [sys.executable, "-m", "evercal", "serve", str(path)]
    command += ["--port", "0", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as service:
        try:
            url = json.loads(next(service.stdout))["url"]
            client = evercal.Client(url)  # this could be another computer
            estimate = client.localize(CELL / "bumped.jpg")
            print(estimate.status, estimate.base_from_camera.translation_m)
            calibration = client.calibrate(CELL / "tripod")
            print(calibration.verdict)
            shift = client.check(CELL / "bumped.jpg", calibration)
            print(f"moved: {shift.moved}, {shift.translation_mm:.1f} mm")
        finally:
            service.terminate()


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "cell.evercal"))
