"""Write tutorials as Jupyter notebooks: python docs/_site/notebooks.py [FOLDER].

The pages are the only source: text becomes Markdown cells, commands and blocks of Python become
code cells. The site offers the notebooks for download.
"""

import json
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

PAGES = Path(__file__).parents[1] / "tutorials"
NOTEBOOKS = ("wrist-camera", "phone-video")
"""Tutorials that are offered as notebooks."""

_BLOCK = re.compile(r"^```python *(\S*)\n(.*?)^```$|^    (\S[^\n]*)$", re.M | re.S)
_LINK = re.compile(r"\[([^\]]+)\]\([^)]+\)")


@dataclass(frozen=True)
class Step:
    """A part of a page."""

    kind: str
    """`text`, `command`, `python`, or the name of the file that a block is saved as."""
    text: str
    code: int = 0
    """Expected exit code of a command."""


def parts(page: str) -> Iterator[Step]:
    """Text, commands and blocks of Python of a page, in its order."""
    end = 0
    for block in _BLOCK.finditer(page):
        if text := page[end : block.start()].strip():
            yield Step("text", text)
        end = block.end()
        name, code, command = block.groups()
        if command is None:
            yield Step(name or "python", code)
            continue
        line, _, comment = command.partition("  # ")
        stated = re.match(r"\s*exit code (\d+)", comment)
        yield Step("command", line.strip(), int(stated[1]) if stated else 0)
    if text := page[end:].strip():
        yield Step("text", text)


def notebook(page: str) -> dict[str, Any]:
    """Return a page as a notebook; the metadata of a command hold its expected exit code."""
    cells = []
    for number, part in enumerate(parts(page)):
        cell: dict[str, Any] = {"id": f"cell-{number}", "metadata": {}}
        if part.kind == "text":
            text = _LINK.sub(
                r"\1", part.text
            )  # there are no other pages beside a notebook
            cells.append({**cell, "cell_type": "markdown", "source": text})
            continue
        source = part.text.strip()
        if part.kind == "command":
            cell["metadata"] = {"exit_code": part.code}
            source = f"!{source}"
        elif part.kind != "python":
            source = f"%%writefile {part.kind}\n{source}"
        cells.append(
            {
                **cell,
                "cell_type": "code",
                "execution_count": None,
                "outputs": [],
                "source": source,
            }
        )
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    metadata = {"kernelspec": kernel, "language_info": {"name": "python"}}
    return {"cells": cells, "metadata": metadata, "nbformat": 4, "nbformat_minor": 5}


def notebook_of(name: str) -> str:
    """Return the text of a tutorial's notebook."""
    page = (PAGES / f"{name}.md").read_text(encoding="utf-8")
    return json.dumps(notebook(page), indent=1, ensure_ascii=False) + "\n"


def main(folder: Path) -> None:
    """Write all notebooks to a folder."""
    for name in NOTEBOOKS:
        (folder / f"{name}.ipynb").write_text(notebook_of(name), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path())
