"""Without an optional package, the error names the command that installs it."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from evercal.recordings.formats import colmap, lerobot
from evercal.recordings.formats.bags.file import BagFile
from evercal.recordings.formats.video_file import Videos

from .checks import refused


@pytest.mark.parametrize(
    ("module", "extra", "read"),
    [
        ("pycolmap", "colmap", colmap._model),
        ("rosbags.highlevel", "bags", BagFile),
        ("pyarrow.parquet", "lerobot", lambda path: lerobot._columns(path, [])),
        ("av", "lerobot", lambda _: Videos(30.0)),
    ],
)
def test_missing_extra_names_the_install_command(
    module: str,
    extra: str,
    read: Callable[[Path], object],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    refused(rf"constraints.txt '\.\[{extra}\]'", read, tmp_path)
