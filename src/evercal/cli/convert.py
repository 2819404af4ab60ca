"""`evercal convert`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from evercal.cli import args
from evercal.errors import InputError
from evercal.progress import progress_bar


@dataclass(frozen=True)
class Convert(args.Verb):
    """Convert a recording of any format to evercal's own; it is scene.json and the images.

    Example: evercal convert recording.mcap kitchen/
    """

    scene: Annotated[Positional[Path], arg(metavar="IN")]
    """Folder of the recording, or file of a bag."""
    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """Output folder; created if it is missing."""
    reading: Annotated[args.Reading, arg(name="")] = field(default_factory=args.Reading)
    name: args.Name = None
    """Name of the scene. Default: the recording's own name."""
    hard_link: bool = False
    """Link image files instead of copying them; changes then affect both."""

    def run(self) -> int:
        from evercal.recordings.formats import generic

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
        record = {
            "out": str(self.out),
            "name": scene.name,
            "train": len(scene.train),
            "test": len(scene.test),
            "untracked": scene.untracked,
            "with_base_from_camera": sum(
                f.base_from_camera is not None for f in frames
            ),
            "with_base_from_gripper": sum(
                f.base_from_gripper is not None for f in frames
            ),
            "notes": list(scene.notes),
        }
        self.answer(
            record,
            f"{self.out}: {scene.name}, {len(scene.train)} training and {len(scene.test)} test"
            f" frames; {record['with_base_from_camera']} with the camera's pose,"
            f" {record['with_base_from_gripper']} with the gripper's; {scene.untracked} images"
            " without a pose left out",
            *(f"note: {note}" for note in scene.notes),
            then=("inspect", self.out),
        )
        return 0
