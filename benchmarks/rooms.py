"""Views of the simulator's rooms, and rendering time."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from tabulate import tabulate

from evercal.reports.overlay import encode_image
from evercal.simulation.box_room import default_camera
from evercal.simulation.cell import SUITES
from evercal.simulation.cell_paths import sweep_shots
from evercal.simulation.furnished.panda import Panda
from evercal.simulation.furnished.renderer import Renderer, RenderOptions, choose_variant
from evercal.simulation.furnished.rooms import room
from evercal.storage import write_bytes

TIMED, COLUMNS = 6, 4


def run(
    out: Path = Path("runs/rooms.jpg"),
    suites: tuple[Literal["sim", "sim-7", "sim-12"], ...] = ("sim",),
    samples: int = 16,
    views: int = 2,
) -> None:
    """Render views of every room as one contact sheet and time them; needs evercal[sim].

    Args:
        out: The sheet, a JPEG.
        suites: Suites whose rooms are rendered.
        samples: Paths per pixel.
        views: Views of each room on the sheet.
    """
    camera, panda, options = default_camera(320, 240), Panda(), RenderOptions(samples=samples)
    images, rows = [], []
    for suite in suites:
        for name, kind, seed in SUITES[suite].rooms:
            furnished = room(kind, seed)
            train = sweep_shots(furnished, 40, 0)[:28]
            shots = [train[int(i)] for i in np.linspace(0, 27, max(views, TIMED))]
            renderer = Renderer(furnished.meshes() + panda.meshes(shots[0].joints_rad))
            seconds = []
            for i, shot in enumerate(shots):
                start = time.perf_counter()
                image = renderer.render(camera, shot.base_from_camera, options, i)
                seconds.append(time.perf_counter() - start)
                if i < views:
                    images.append(labelled(image, f"{suite}: {name}"))
            # The first frame compiles the kernels.
            rate = 1 / float(np.median(seconds[1:]))
            rows.append([suite, name, len(furnished.items), rate])
            print(f"{suite} {name}: {rate:.2f} frames/s", flush=True)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(out, encode_image(sheet(images), "jpg"))
    print(f"\n320x240, {samples} samples, {': '.join(choose_variant())}\n")
    header = ["suite", "room", "things", "frames/s"]
    print(tabulate(rows, header, "github", floatfmt=".2f"))


def labelled(image: np.ndarray, text: str) -> np.ndarray:
    """A copy of an image (H, W, 3) with a line of text at the top left."""
    import cv2

    return cv2.putText(image.copy(), text, (4, 14), 0, 0.45, (255, 0, 0), 1, cv2.LINE_AA)


def sheet(images: Sequence[np.ndarray]) -> np.ndarray:
    """Images (H, W, 3) of one size in rows of COLUMNS, the last row filled with white."""
    blank = [np.full_like(images[0], 255)] * (-len(images) % COLUMNS)
    filled = [*images, *blank]
    rows = [np.hstack(filled[i : i + COLUMNS]) for i in range(0, len(filled), COLUMNS)]
    return np.vstack(rows)
