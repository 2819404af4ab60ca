"""`evercal evaluate`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional

from evercal.classes import frozen
from evercal.cli import args
from evercal.cli.console import table
from evercal.errors import InputError
from evercal.progress import following, progress_bar

if TYPE_CHECKING:
    from evercal.recordings import Recording


@frozen
class Evaluate(args.Verb):
    """Measure the localization accuracy on the test frames of scenes.

    Example: evercal evaluate cell.evercal kitchen/
    """

    store: args.Store
    scenes: Annotated[Positional[tuple[str, ...]], args.shown("[NAME=]SCENE...")]
    """Folders of recorded scenes. NAME is the scene's name in the store, if it differs."""
    device: args.Device = "auto"

    def run(self) -> int:
        if not self.scenes:
            raise InputError(
                "no scene given; name one or more scene folders after the store"
            )
        scenes = load_named(self.scenes)
        from evercal.evaluation import evaluate, scores
        from evercal.evaluation.tables import score_rows

        localizer = args.open_localizer(self.store, self.device)
        with progress_bar("evaluating", 0, "image") as bar:
            results = evaluate(localizer, scenes, on_frame=following(bar))
        summary = scores(results)
        self.answer(
            summary.to_dict(),
            *table(score_rows(summary)),
            f"{summary.ms_per_image:.0f} ms per image, one at a time, decoding included",
            then=("learn", self.store, "SCENE"),
        )
        return 0


def load_named(words: tuple[str, ...]) -> "dict[str, Recording]":
    """Load scenes from the words `SCENE` and `NAME=SCENE`."""
    from evercal.recordings import load_recording

    scenes: dict[str, Recording] = {}
    for word in words:
        name, sign, path = word.partition("=")
        # The name of a folder may contain '='.
        if not sign or not name or "/" in name or Path(word).is_dir():
            name = ""
            path = word
        scene = load_recording(path, name=name or None)
        if not scene.metric:
            raise InputError(
                f"{path}: the unit of length of its poses is unknown, so there are no millimetres"
                " to measure; if it is the metre, convert it with 'evercal convert --metres'"
            )
        if scene.name in scenes:
            raise InputError(
                f"scene {scene.name!r} was given twice; pass NAME={path} with the name of the"
                " scene in the store"
            )
        scenes[scene.name] = scene
    return scenes
