#!/usr/bin/env bash
# Guess: a COLMAP model written as text and read again by pycolmap is the same model.
# Found with pycolmap 4.2.1: the writer keeps names of images with blanks, the reader cuts them at
# the first blank. So "front/IMG 0001 (1).jpg" becomes "front/IMG", without a warning. The binary
# files of the same model keep the name. Names that are cut can become equal to each other.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "pycolmap==4.2.1" "numpy==2.4.6"
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import sys
from pathlib import Path

import pycolmap

print("pycolmap", pycolmap.__version__)
model = pycolmap.Reconstruction()
model.add_camera_with_trivial_rig(
    pycolmap.Camera(model="SIMPLE_PINHOLE", width=64, height=48, camera_id=1, params=[50, 32, 24])
)
name = "front/IMG 0001 (1).jpg"
image = pycolmap.Image(name=name, camera_id=1, image_id=1)
model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
read = {}
for kind, write in (("bin", model.write_binary), ("txt", model.write_text)):
    folder = Path(sys.argv[1], kind)
    folder.mkdir()
    write(str(folder))
    read[kind] = pycolmap.Reconstruction(str(folder)).images[1].name
    print(f"{kind}: {name!r} is read as {read[kind]!r}")
assert name in Path(sys.argv[1], "txt", "images.txt").read_text()
assert read == {"bin": name, "txt": "front/IMG"}
print("as described")
PYTHON
