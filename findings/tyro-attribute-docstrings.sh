#!/usr/bin/env bash
# tyro 1.0.17 breaks the help of an option where its source does, if the docstring below the field has
# several lines. It joins only lines that begin with a letter, and the lines of such a docstring keep
# the indentation of the class body. The same sentence in the `Attributes` section of the class
# docstring is joined and wrapped, but for lines that begin with an option's dashes or a digit.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet tyro==1.0.17 docstring-parser==0.18.0
cd "$folder"
cat > app.py <<'PYTHON'
from dataclasses import dataclass

import tyro


@dataclass
class Below:
    """Field with a docstring below it."""

    rate: int = 1
    """Frames of a second that are
    read from the camera."""


@dataclass
class Above:
    """Field in the docstring of its class.

    Attributes:
        rate: Frames of a second that are
            read from the camera.
        most: Frames at most, instead of
            --rate times the seconds.
    """

    rate: int = 1
    most: int = 1


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict({"below": Below, "above": Above})
PYTHON
"$folder/venv/bin/python" - <<'PYTHON'
import os
import subprocess
import sys
from importlib.metadata import version

print("tyro", version("tyro"))
lines = {}
for name in ("below", "above"):
    shown = subprocess.run(
        [sys.executable, "app.py", name, "--help"],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "COLUMNS": "100"},
    ).stdout
    print(shown)
    lines[name] = [line.strip("│ \n") for line in shown.splitlines()]
joined = "Frames of a second that are read from the camera."
assert not any(joined in line for line in lines["below"])
assert any(joined in line for line in lines["above"])
assert any(line.startswith("--rate times") for line in lines["above"])
PYTHON
