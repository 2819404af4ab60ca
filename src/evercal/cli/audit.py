"""`evercal audit`."""

import dataclasses
from typing import Annotated

from tyro.conf import arg

from evercal.classes import frozen
from evercal.cli import args
from evercal.errors import InputError
from evercal.progress import progress_bar


@frozen
class Audit(args.Verb):
    """List recorded episodes whose stated camera pose is wrong.

    The pose is compared with the images of the episode. Exit code 1 if any is wrong.

    Example: evercal audit cell.evercal episodes/ --calibration tripod.json
    """

    store: args.Store
    folder: args.InFolder
    """Folder whose folders are the episodes: recorded scenes, or images beside a calibration.json
    or a 4x4 matrix base_from_camera.txt."""
    calibration: args.File = None
    """Pose of the camera in episodes that state none themselves."""
    scene: args.Scenes = ()
    images: args.Number = 5
    """Images per episode that are located."""
    most_mm: Annotated[float, arg(metavar="MM")] = 5.0
    """Tolerance of the position."""
    most_deg: Annotated[float, arg(metavar="DEG")] = 0.5
    """Tolerance of the rotation."""

    def run(self) -> int:
        if self.images < 1 or self.most_mm <= 0 or self.most_deg <= 0:
            raise InputError(
                "--images is at least 1, --most-mm and --most-deg are above 0"
            )
        from evercal.calibration.audit import audit, episode_folders

        stated = args.transform_of(self.calibration)
        total = len(episode_folders(self.folder))
        localizer = args.open_map(self.store, self.scene)
        most = (self.most_mm, self.most_deg)
        with progress_bar("episodes", total, "episode") as bar:
            episodes = audit(
                localizer, self.folder, stated, self.images, most, bar.update
            )
        wrong = 0
        records = []
        lines = []
        for episode in episodes:
            wrong += episode.verdict == "wrong"
            records.append(dataclasses.asdict(episode))
            lines.append(f"{episode.verdict:8s} {episode.name}: {episode.reason}")
        lines.append(f"{wrong} of {len(episodes)} episodes state a wrong camera pose")
        self.answer({"episodes": records}, *lines)
        return 1 if wrong else 0
