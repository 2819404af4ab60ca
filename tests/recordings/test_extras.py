"""Without an optional package, the error names the command that installs it, or another way."""

import platform
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from evercal.recordings.episodes import droid
from evercal.recordings.formats import lerobot
from evercal.recordings.formats.bags.file import BagFile
from evercal.recordings.formats.video_file import Videos
from evercal.recordings.reconstruct import reconstruct

from .checks import refused


@pytest.mark.parametrize(
    ("module", "extra", "read"),
    [
        ("pycolmap", "colmap", lambda path: reconstruct(path, path / "out")),
        ("rosbags.highlevel", "bags", BagFile),
        ("pyarrow.parquet", "lerobot", lambda path: lerobot.columns(path, [])),
        ("av", "lerobot", lambda _: Videos(30.0)),
        ("h5py", "droid", droid.joint_values),
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


def test_where_a_package_has_no_wheels_the_error_names_another_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    monkeypatch.setattr(platform, "system", lambda: "Linux")
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    message = "no wheel for Linux arm64: .*apt-get install colmap.*another computer"
    refused(message, reconstruct, tmp_path, tmp_path / "out")
