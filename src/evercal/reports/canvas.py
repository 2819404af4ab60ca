"""What all charts share: the figure, its colours and the bytes of its file."""

import io
import warnings
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999")
"""Those of Okabe and Ito, which the colour-blind can tell apart."""


def new_figure(width: float, height: float) -> "Figure":
    """An empty figure on white, inches.

    Made without pyplot, it draws itself with Agg and belongs to no global state.
    """
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=150, layout="constrained", facecolor="white")


def png_bytes(figure: "Figure") -> bytes:
    """A PNG file; without the program's name and version the same chart gives the same bytes."""
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # A name in letters that the font lacks is drawn as boxes; the page has it in full.
        warnings.filterwarnings("ignore", "Glyph .* missing from font")
        figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def plain(text: str) -> str:
    """Text that is shown as it is, where matplotlib would read formulas between dollar signs."""
    return text.replace("$", r"\$")
