"""`evercal convert`."""

from dataclasses import field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from evercal.classes import frozen
from evercal.cli import args
from evercal.errors import InputError
from evercal.progress import progress_bar


@frozen
class Convert(args.Verb):
    """Convert a recording of any format to evercal's own; it is scene.json and the images.

    Example: evercal convert recording.mcap kitchen/
    """

    scene: Annotated[Positional[Path], arg(metavar="IN")]
    """Folder of the recording, or file of a bag."""
    out: args.NewFolder
    """Output folder; created if it is missing."""
    reading: args.HowRead = field(default_factory=args.Reading)
    name: args.Name = None
    """Name of the scene. Default: the recording's own name."""
    hard_link: bool = False
    """Link image files instead of copying them; changes then affect both."""

    def run(self) -> int:
        from evercal.recordings.formats import generic
        from evercal.recordings.frame import stated_grippers, stated_poses

        if self.out.exists() and not self.out.is_dir():
            raise InputError(f"{self.out}: is a file; give a folder to write to")
        scene = self.reading.recording(self.scene, self.name)
        frames = (*scene.train, *scene.test)
        if not frames:
            raise InputError(
                f"{self.scene}: no frame to write; see 'evercal inspect {self.scene}'"
            )
        with progress_bar("writing", len(frames), "image") as bar:
            generic.write(self.out, scene, link=self.hard_link, on_frame=bar.update)
        train = len(scene.train)
        test = len(scene.test)
        cameras = len(stated_poses(frames))
        grippers = len(stated_grippers(frames))
        record = {
            "out": str(self.out),
            "name": scene.name,
            "train": train,
            "test": test,
            "untracked": scene.untracked,
            "with_base_from_camera": cameras,
            "with_base_from_gripper": grippers,
            "notes": list(scene.notes),
        }
        self.answer(
            record,
            f"{self.out}: {scene.name}, {train} training and {test} test frames; {cameras} with the"
            f" camera's pose, {grippers} with the gripper's; {scene.untracked} images without a"
            " pose left out",
            *map("note: {}".format, scene.notes),
            then=("inspect", self.out),
        )
        return 0
