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


def test_wrong_arguments_are_named(run: Run, store: Path, tmp_path: Path) -> None:
    for words, message in (
        (("track", store, tmp_path / "none"), "no such folder or video"),
        (("track", store, tmp_path, "--out", tmp_path / "t.bin"), "ends with .jsonl"),
        (("track", store, tmp_path, "--rate", 0), "above 0"),
        (("refresh", store), "give images of the changed room, or --undo SCENE"),
        (("refresh", store, "--undo", "attic"), "scene 'attic'"),
        (("refresh", store, tmp_path), "image"),
    ):
        ran = run(*words)
        assert ran.code == 2, words
        assert message in ran.err[-1], (words, ran.err)
