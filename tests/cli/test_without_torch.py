"""Without PyTorch the product works, and verbs of networks name the extra that brings it."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from evercal.recordings.images import write_image
from evercal.storage.manifest import MANIFEST, write_manifest

WITHOUT = """
import sys
from importlib.machinery import PathFinder
find = PathFinder.find_spec
PathFinder.find_spec = lambda name, *more: None if name == "torch" else find(name, *more)
from evercal.cli import main
sys.exit(main())
"""
EXTRA = "error: networks need torch; in the checkout of evercal, run: python -m pip install -c"
EXTRA += " constraints.txt '.[networks]'\n"


def without_torch(*words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", WITHOUT, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


@pytest.fixture
def meant(hall_store, rooms, still_images, tmp_path) -> dict[str, Path]:
    """Paths by word; the manifest of NETWORKS says that it holds networks."""
    root = Path(shutil.copytree(hall_store, tmp_path / "networks"))
    manifest = json.loads((root / MANIFEST).read_text())
    changed = manifest["payload"] | {"kind": "networks", "strategy": "er"}
    write_manifest(root, changed, list(manifest["files"]))
    new = tmp_path / "new"
    image = still_images / "00.png"
    return {"NEW": new, "NETWORKS": root, "ROOM": rooms[0], "IMAGE": image}


@pytest.mark.parametrize(
    "words",
    [
        "learn NEW ROOM --strategy er",
        "localize NETWORKS IMAGE",
        "evaluate NETWORKS ROOM",
        "info NETWORKS",
        "bench sim-mini",
    ],
)
def test_networks_name_the_extra(words, meant):
    done = without_torch(*(meant.get(word, word) for word in words.split()))
    assert (done.returncode, done.stdout, done.stderr) == (2, "", EXTRA)
    assert not meant["NEW"].exists()


def test_maps_need_no_torch(hall_store, hall, tmp_path):
    write_image(tmp_path / "image.png", hall.test[7].read_image())
    done = without_torch("localize", hall_store, tmp_path / "image.png")
    assert done.returncode == 0, done.stderr
    assert "scene        hall" in done.stdout
