"""Every exported text is parsed again before it is written."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from evercal.calibration.export.formats import FORMATS
from evercal.errors import InputError

from .random_poses import POSE, calibration_of
from .test_one_pose import READERS

TF_FORMATS = [name for name, exporter in FORMATS.items() if exporter.frame == "tf"]


@pytest.mark.parametrize(
    "parent",
    ["a---b", "a--", "1cam", "_cam", "1e5", "1e-5", "1.5e3", "0o17", "0x1f", "12"],
)
@pytest.mark.parametrize("name", TF_FORMATS)
def test_odd_frame_names_are_read_back(name: str, parent: str) -> None:
    text = calibration_of(POSE).export(name, parent=parent, child=f"{parent}.x")
    _, read_parent, read_child = READERS[name](text)
    assert (read_parent, read_child) == (parent, f"{parent}.x")
    if name.endswith(("launch_py", "ros1_launch")):
        (node,) = re.findall(r"name=\"(.*?)\"", text)
        assert re.fullmatch(r"[a-zA-Z]\w*", node, re.ASCII)
    # As a number of YAML 1.2, it would be another text to those who read that.
    if re.fullmatch(r"\d+(\.\d*)?([eE][-+]?\d+)?|0o[0-7]+|0x[\da-f]+", parent):
        assert not re.search(rf": {parent}$", text, re.MULTILINE)


@pytest.mark.parametrize(
    ("name", "written", "wrong", "message"),
    [
        ("urdf", "-->", "-- -->", "not well-formed"),
        ("urdf", "<parent link=", "<parent link='x' link=", "duplicate attribute"),
        ("transform_stamped", "    x: ", "    x: 1", "the numbers"),
        ("easy_handeye", "  z: ", "  z: -", "the numbers"),
        (
            "launch_py",
            '"--frame-id", "',
            '"--frame-id", "other_',
            "it lacks a frame",
        ),
        ("static_transform_publisher", "--x ", "--x '", "No closing quotation"),
        ("kuka", "{X ", "{X 9", "the numbers"),
        ("csv", ",", ",9", "the numbers|window"),
    ],
)
def test_what_would_be_read_in_another_way_is_not_written(
    name: str, written: str, wrong: str, message: str, tmp_path: Path
) -> None:
    """Every text is parsed once more before it is written."""
    exporter = FORMATS[name]

    def write(export: Any) -> str:
        text = exporter.write(export)
        assert isinstance(text, str)
        assert written in text
        return text.replace(written, wrong, 1)

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(FORMATS, name, replace(exporter, write=write))
        with pytest.raises(
            InputError, match=f"{name}: it would not be read .*({message})"
        ):
            calibration_of(POSE).export(name, tmp_path / "out")
    assert not (tmp_path / "out").exists()
