#!/usr/bin/env bash
# Guess: cv2.imdecode treats TIFF as it treats PNG: IMREAD_COLOR_RGB gives the colours in the order
# red, green, blue, and IMREAD_IGNORE_ORIENTATION gives the pixels as they are stored.
# Found with opencv-python-headless 5.0.0.93, in files that Pillow 13.0.0 and OpenCV itself wrote:
# - A colour TIFF of 16 bits with IMREAD_COLOR_RGB | IMREAD_ANYDEPTH has arbitrary pixels, without an
#   error; IMREAD_COLOR is right. (5.1.0.95 of opencv-contrib-python is right with both.)
# - A TIFF is turned upright whatever the flags. IMREAD_UNCHANGED and IMREAD_IGNORE_ORIENTATION
#   leave JPEG, PNG and WebP as they are stored, but not TIFF. Pillow turns TIFF, too, when it loads
#   the pixels, and no other format; Image.size before that is the stored one.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "opencv-python-headless==5.0.0.93" "pillow==13.0.0" "numpy==2.4.6"
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import sys
from pathlib import Path

import cv2
import numpy as np
import PIL
from PIL import Image

print("opencv", cv2.__version__, "pillow", PIL.__version__)
deep = np.arange(24 * 32 * 3, dtype=np.uint16).reshape(24, 32, 3) * 28
right = {}
for ending in (".png", ".tif"):
    data = cv2.imencode(ending, deep)[1]
    for name, order in (("IMREAD_COLOR", 1), ("IMREAD_COLOR_RGB", -1)):
        image = cv2.imdecode(data, getattr(cv2, name) | cv2.IMREAD_ANYDEPTH)
        right[ending, name] = bool((image == deep[:, :, ::order]).all())
        print(f"16 bits, {ending}, {name}: {'right' if right[ending, name] else 'wrong'} pixels")

stored, exif, shapes, loaded = np.zeros((40, 64, 3), np.uint8), Image.Exif(), {}, {}
exif[0x112] = 6
for ending in (".jpg", ".png", ".webp", ".tif"):
    path = Path(sys.argv[1], f"a{ending}")
    how = {"tiffinfo": {0x112: 6}} if ending == ".tif" else {"exif": exif}
    Image.fromarray(stored).save(path, **how)
    data = np.fromfile(path, np.uint8)
    flags = cv2.IMREAD_UNCHANGED, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    shapes[ending] = {cv2.imdecode(data, each).shape[:2] for each in flags}
    loaded[ending] = np.asarray(Image.open(path)).shape[:2]
    print(f"orientation 6, stored 40x64, {ending}: {shapes[ending]}, Pillow {loaded[ending]}")
assert right == {key: key != (".tif", "IMREAD_COLOR_RGB") for key in right}
for read in (shapes, {key: {value} for key, value in loaded.items()}):
    assert read == {key: {(64, 40) if key == ".tif" else (40, 64)} for key in read}
print("as described")
PYTHON
