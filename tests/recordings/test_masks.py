"""Masks beside images."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from evercal.recordings import load_recording, write_image
from evercal.recordings.samples import FOLDER

from .checks import refused

WRIST = FOLDER.parent / "sample_cell/wrist"
FIRST = sorted(WRIST.rglob("*.jpg"))[0].stem


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    shutil.copytree(WRIST, tmp_path / "wrist")
    (tmp_path / "wrist" / "masks").mkdir()
    return tmp_path / "wrist"


@pytest.mark.parametrize("ending", [".png", ".jpg.png"])
def test_what_is_black_has_one_colour_and_the_rest_stays(
    recording: Path, ending: str
) -> None:
    old, second = load_recording(WRIST).train[:2]
    pixels = old.read_image()
    mask = np.full(pixels.shape, 255, np.uint8)
    mask[60:180, 100:220] = 0
    write_image(recording / "masks" / f"{FIRST}{ending}", mask)
    loaded = load_recording(recording)
    new = loaded.train[0].read_image()
    assert "Masks of 1 of" in loaded.notes[-1]
    inner = new[80:160, 120:200].reshape(-1, 3)
    assert np.ptp(inner, axis=0).max() <= 1
    np.testing.assert_allclose(inner.mean(0), pixels[mask[..., 0] > 0].mean(0), atol=8)
    np.testing.assert_array_equal(new[:40], pixels[:40])
    np.testing.assert_array_equal(loaded.train[1].read_image(), second.read_image())


def test_masks_of_another_size_or_name_are_refused(recording: Path) -> None:
    small = np.zeros((4, 4, 3), np.uint8)
    write_image(recording / "masks" / "other.png", small)
    refused("no mask has the name of an image", load_recording, recording)
    write_image(recording / "masks" / f"{FIRST}.png", small)
    frame = load_recording(recording).train[0]
    refused("mask is 4x4, its image", frame.read_image)
