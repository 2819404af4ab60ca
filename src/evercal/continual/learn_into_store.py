"""`evercal.learn`: a recording into a store, with the defaults of `evercal learn`."""

import os
from pathlib import Path

from evercal.continual.learn_scene import LearnOptions, LearnReport, OnEvent, learn_scene
from evercal.continual.presets import PRESETS, Preset, short_side
from evercal.continual.presets import preset as stage_options
from evercal.continual.strategies import strategy_named
from evercal.errors import InputError
from evercal.mapping.memory_budget import with_memory
from evercal.recordings import Recording, load_recording
from evercal.storage import MANIFEST, read_manifest


def learn(
    store: str | os.PathLike[str],
    scene: str | os.PathLike[str] | Recording,
    *,
    preset: Preset = "fast",
    memory: str | int = "10%",
    strategy: str | None = None,
    device: str = "auto",
    on_event: OnEvent | None = None,
) -> LearnReport:
    """Learns a scene into a store, or goes on where an interrupted call of the same kind stopped.

    Args:
        store: folder of the store; made when missing.
        scene: folder of a recorded scene, or the scene itself. Its training frames are learned, its
            test frames are not looked at.
        preset: work of strategies that train a network; a map takes no notice of it.
        memory: keyframes to keep of the scene: a share of its frames ("10%"), bytes ("5MB"), or
            "auto": the fewest with which its other frames are located well.
        strategy: "evercal" builds a map, other names train a network; that of the store when left
            out, and "evercal" for a new store.
        device: what networks run on: "auto" (a CUDA device where there is one), "cpu", "cuda".
        on_event: called with everything that happens, for progress bars.

    Returns:
        What came out: keyframes, landmarks, what bundle adjustment changed.

    Raises:
        InputError: a recording or store that cannot be used, or an argument that is none of those
            above.
    """
    if preset not in PRESETS:
        raise InputError(f"preset {preset!r}: unknown; use one of {', '.join(PRESETS)}")
    stage = with_memory(stage_options(preset), memory)
    root = Path(store)
    recorded = scene if isinstance(scene, Recording) else load_recording(scene)
    options = LearnOptions(
        stage,
        strategy_named(strategy or _made_with(root)),
        short_side=short_side(preset),
        device=device,
    )
    return learn_scene(root, recorded, options, on_event)


def _made_with(root: Path) -> str:
    """The strategy of a store, or the default one where there is no store yet."""
    default = LearnOptions.strategy.name
    return str(read_manifest(root)["strategy"]) if (root / MANIFEST).exists() else default
