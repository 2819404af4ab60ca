"""Image files that a user names: files, or folders of them."""

from collections.abc import Sequence
from pathlib import Path

from evercal.errors import InputError
from evercal.recordings.images import IMAGE_ENDINGS, files_in
from evercal.typing import PathLike


def image_files(paths: Sequence[PathLike]) -> list[Path]:
    """Image files; a folder stands for its images, image-2 before image-10."""
    if not paths:
        raise InputError("no image given; name one or more image files or a folder")
    files: list[Path] = []
    for path in map(Path, paths):
        if path.is_dir():
            images = files_in(path)
            if not images:
                raise InputError(
                    f"{path}: no images in this folder ({', '.join(IMAGE_ENDINGS)})"
                )
            files += images
        elif path.is_file():
            files.append(path)
        else:
            raise InputError(
                f"{path}: image file is missing, or no file; check the path"
            )
    return files
