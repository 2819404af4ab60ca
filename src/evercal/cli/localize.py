"""`evercal localize`."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from evercal.cli.console import print_json, print_next, progress_bar
from evercal.cli.device import Device
from evercal.cli.image_words import camera_for
from evercal.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from evercal.geometry import Camera
    from evercal.localization.estimate import PoseEstimate
    from evercal.localization.localizer import Localizer


@dataclass(frozen=True)
class Localize:
    """Say where the camera was that took an image, in the base frame of the scene it shows."""

    store: Annotated[Positional[Path], arg(metavar="STORE")]
    """Folder of the store."""
    images: Annotated[Positional[tuple[Path, ...]], arg(metavar="IMAGE...", help_behavior_hint="")]
    """Image files, one or more."""
    camera: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """File of the intrinsics: a 3x3 matrix as text, our JSON, or a ROS camera_info YAML. Without it
    they are those of the scene that is found."""
    overlay: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Folder for copies of the images with the landmarks that were found drawn in."""
    device: Device = "auto"
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        """Localizes every image; nothing is printed before all of them could be read."""
        if not self.images:
            raise InputError("no image given; name one or more image files after the store")
        for path in self.images:
            if not path.is_file():
                raise InputError(f"{path}: image file is missing; check the path")
        camera = camera_for(self.camera, self.images)
        from evercal.localization.localizer import Localizer

        localizer = Localizer.open(self.store, device=self.device)
        if self.overlay is not None:
            self.overlay.mkdir(parents=True, exist_ok=True)
        answers = self._answers(localizer, camera)
        found = sum(estimate.status == "ok" for _, estimate, _ in answers)
        if self.json:
            print_json({"images": [as_dict(path, answer, ms) for path, answer, ms in answers]})
        else:
            for path, answer, ms in answers:
                print(as_text(path, answer, ms))
            self._next(found)
        return 0 if found else 1

    def _answers(
        self, localizer: "Localizer", camera: "Camera | None"
    ) -> list[tuple[Path, "PoseEstimate", float]]:
        """Per image its path, the answer and the milliseconds that it took, decoding included."""
        from evercal.localization.parallel import in_parallel
        from evercal.recordings import read_image, write_image
        from evercal.reports.pictures import draw_estimate, scene_camera

        def answer(number: int) -> tuple[Path, "PoseEstimate", float]:
            path, began = self.images[number], time.perf_counter()
            image = read_image(path)
            estimate = localizer.localize(image, camera)
            ms = 1000 * (time.perf_counter() - began)
            if self.overlay is not None and estimate.scene is not None:
                lens = camera or scene_camera(localizer, estimate.scene)
                drawn = draw_estimate(image, estimate, lens)
                write_image(self.overlay / self._overlay_name(number), drawn)
            return path, estimate, ms

        answers = []
        with progress_bar("localizing", len(self.images), "image") as bar:
            for found in in_parallel(answer, range(len(self.images))):
                answers.append(found)
                bar.update()
        return answers

    def _overlay_name(self, number: int) -> str:
        """A file name; images of the same name from two folders do not overwrite each other."""
        stems = [path.stem for path in self.images]
        again = f"-{number + 1}" if stems.count(stems[number]) > 1 else ""
        return f"{stems[number]}{again}-overlay.png"

    def _next(self, found: int) -> None:
        if not found:
            print_next("evercal", "learn", self.store, "SCENE")
        elif self.overlay is None:
            print_next("evercal", "localize", self.store, *self.images[:1], "--overlay", "DIR")
        else:
            print_next("evercal", "evaluate", self.store, "SCENE")


def as_dict(path: Path, estimate: "PoseEstimate", milliseconds: float) -> dict[str, object]:
    """One image's entry in the JSON answer; null where there is no pose."""
    import numpy as np

    from evercal.recordings.formats.generic import pose_to_dict

    pose, covariance = pose_to_dict(estimate.base_from_camera), estimate.covariance
    if pose is not None and estimate.base_from_camera is not None:
        pose["matrix"] = estimate.base_from_camera.matrix().tolist()
    usable = covariance is not None and bool(np.isfinite(covariance).all())
    return {
        "path": str(path),
        "status": estimate.status,
        "reason": estimate.reason,
        "scene": estimate.scene,
        "base_from_camera": pose,
        "covariance": covariance.tolist() if covariance is not None and usable else None,
        "inliers": int(estimate.inliers),
        "inlier_ratio": float(estimate.inlier_ratio),
        "ms": milliseconds,
    }


def as_text(path: Path, estimate: "PoseEstimate", milliseconds: float) -> str:
    """One image's block for people."""
    import numpy as np

    share = f"{estimate.inliers} ({100 * estimate.inlier_ratio:.0f} %), {milliseconds:.0f} ms"
    if estimate.base_from_camera is None:
        no = estimate.status.replace("_", " ")
        return f"{path}\n  {no}: {estimate.reason}\n  inliers      {share}"
    pose = estimate.base_from_camera
    spread = [""] * 2
    if estimate.covariance is not None:
        sd = np.sqrt(np.maximum(np.diag(estimate.covariance), 0))
        spread = [_numbers(100 * sd[:3], ".2f"), _numbers(np.rad2deg(sd[3:]), ".2f")]
        spread = [f"  sd {spread[0]} cm", f"  sd {spread[1]} deg"]
    return "\n".join(
        [
            str(path),
            f"  scene        {estimate.scene}",
            f"  translation  {_numbers(pose.translation_m, '+.4f')} m{spread[0]}",
            f"  quaternion   {_numbers(pose.rotation_wxyz, '+.4f')} wxyz{spread[1]}",
            f"  inliers      {share}",
        ]
    )


def _numbers(values: "np.ndarray", form: str) -> str:
    return " ".join(format(float(value), form) for value in values)
