"""Images and cameras as words of a command, for every verb that takes images."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from evercal.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from evercal.geometry import Camera


def image_files(words: Sequence[Path]) -> list[Path]:
    """Image files that words name; a folder stands for its images, image-2 before image-10.

    Raises:
        InputError: no word, a file that is missing, or a folder without images.
    """
    if not words:
        raise InputError("no image given; name one or more image files after the store")
    from evercal.recordings.images import IMAGE_ENDINGS
    from evercal.recordings.poses.row_files import natural_key

    files: list[Path] = []
    for word in words:
        if word.is_dir():
            inside = [p for p in word.iterdir() if p.suffix.lower() in IMAGE_ENDINGS]
            inside.sort(key=lambda p: natural_key(p.name))
            if not inside:
                raise InputError(f"{word}: no images in this folder ({', '.join(IMAGE_ENDINGS)})")
            files += inside
        elif word.is_file():
            files.append(word)
        else:
            raise InputError(f"{word}: image file is missing; check the path")
    return files


def read_images(files: Sequence[Path]) -> "list[tuple[str, np.ndarray]]":
    """(path, pixels) of image files."""
    from evercal.recordings import read_image

    return [(str(path), read_image(path)) for path in files]


def camera_for(file: Path | None, images: Sequence[Path]) -> "Camera | None":
    """The camera that --camera names, for the size of the first image."""
    if file is None:
        return None
    from evercal.recordings import image_size
    from evercal.recordings.poses.camera_file import read_camera

    return read_camera(file, image_size(images[0]))
