"""`evercal evaluate`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from evercal.cli.console import print_json, print_next, progress_bar
from evercal.cli.device import Device
from evercal.errors import InputError

if TYPE_CHECKING:
    from evercal.recordings import Recording


@dataclass(frozen=True)
class Evaluate:
    """Measure accuracy on the test frames of scenes; nothing tells which scene an image shows."""

    store: Annotated[Positional[Path], arg(metavar="STORE")]
    """Folder of the store."""
    scenes: Annotated[
        Positional[tuple[str, ...]], arg(metavar="[NAME=]SCENE...", help_behavior_hint="")
    ]
    """Folders of recorded scenes; write NAME=SCENE where the store knows one by another name."""
    report: Annotated[Path | None, arg(metavar="FILE.html", help_behavior_hint="")] = None
    """HTML file to write error curves, trajectories and the worst frames to."""
    device: Device = "auto"
    json: bool = False
    """Print one JSON object."""

    def run(self) -> int:
        """Evaluates and prints a table."""
        if not self.scenes:
            raise InputError("no scene given; name one or more scene folders after the store")
        scenes = load_named(self.scenes)
        if self.report is not None and not self.report.absolute().parent.is_dir():
            raise InputError(f"--report {self.report}: its folder does not exist; make it first")
        from evercal.evaluation import evaluate, scores
        from evercal.evaluation.tables import score_table
        from evercal.localization.localizer import Localizer
        from evercal.reports.evaluate_page import Watch, evaluation_page
        from evercal.storage import write_bytes

        watch = Watch(Localizer.open(self.store, device=self.device), scenes)
        with progress_bar("evaluating", 0, "image") as bar:

            def show(done: int, total: int) -> None:
                bar.total = total
                bar.update(done - bar.n)

            results = evaluate(watch, watch.watched, on_frame=show)
        summary = scores(results)
        if self.report is not None:
            page = evaluation_page(watch, results, summary, str(self.store))
            write_bytes(self.report, page.encode())
        if self.json:
            print_json(summary.to_dict())
            return 0
        print(score_table(summary))
        print(f"{summary.ms_per_image:.0f} ms per image, one at a time, decoding included")
        if self.report is None:
            words = [*self.scenes, "--report", "report.html"]
            print_next("evercal", "evaluate", self.store, *words)
        else:
            print(f"wrote {self.report}")
            print_next("evercal", "learn", self.store, "SCENE")
        return 0


def load_named(words: tuple[str, ...]) -> "dict[str, Recording]":
    """Scenes by name, from `SCENE` and `NAME=SCENE` words.

    Raises:
        InputError: A scene that cannot be read, or one name twice.
    """
    from evercal.recordings import load_recording

    scenes: dict[str, Recording] = {}
    for word in words:
        name, sign, path = word.partition("=")
        # A folder whose own name holds '=' is still a folder.
        if not sign or not name or Path(word).is_dir():
            name, path = "", word
        scene = load_recording(path, name=name or None)
        if scene.name in scenes:
            raise InputError(
                f"scene {scene.name!r}: given twice; tell them apart as NAME={path}, with the name"
                f" under which it was learned"
            )
        scenes[scene.name] = scene
    return scenes
