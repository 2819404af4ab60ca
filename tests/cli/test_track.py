"""`evercal track` and `evercal refresh` on the command line."""

import json
from pathlib import Path

from .conftest import Run


def test_a_folder_is_tracked_into_files(
    run: Run, store: Path, rooms: tuple[Path, Path], tmp_path: Path
) -> None:
    images, tum = rooms[0] / "images", tmp_path / "t.tum"
    lines = tmp_path / "t.jsonl"
    ran = run("track", store, images, "--out", tum, lines, "--most", 6, "--json")
    report = json.loads(ran.out)
    assert report["frames"] == 6
    assert report["tracking"] + report["relocalized"] + report["lost"] == 6
    assert ran.code == (0 if report["tracking"] + report["relocalized"] else 1)
    assert len(lines.read_text().splitlines()) == 6
    located = report["tracking"] + report["relocalized"]
    assert len(tum.read_text().splitlines()) == 1 + located
