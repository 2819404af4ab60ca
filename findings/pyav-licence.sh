#!/usr/bin/env bash
# Guess: FFmpeg in PyAV's wheel states the licence that follows from what it is built with. FFmpeg's
# own build refuses x264 and x265, which are under the GPL, unless it is configured as GPL.
# Found with PyAV 18.1.0, wheel for Linux x86-64: libavcodec states "LGPL version 3 or later" and
# was configured without --enable-gpl, but with --enable-libx264 and --enable-libx265. It is linked
# with both, and the wheel holds them. The package's metadata states BSD-3-Clause. So neither
# metadata nor FFmpeg's own statement tells that who passes the wheel on passes on GPL libraries.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "av==18.1.0"
"$folder/venv/bin/python" - <<'PYTHON'
import ctypes
from importlib.metadata import metadata, version
from pathlib import Path

import av

libraries = Path(av.__file__).parents[1] / "av.libs"
codec = ctypes.CDLL(str(next(libraries.glob("libavcodec*"))))
for name in ("avcodec_license", "avcodec_configuration"):
    getattr(codec, name).restype = ctypes.c_char_p
licence = codec.avcodec_license().decode()
options = codec.avcodec_configuration().decode().split()
held = sorted(path.name.split("-")[0] for path in libraries.glob("libx26*"))
print("PyAV", version("av"), "metadata:", metadata("av")["License-Expression"])
print("libavcodec states:", licence)
print("configured with:", [o for o in options if "gpl" in o or "x26" in o or "version3" in o])
print("in the wheel:", held)
assert licence == "LGPL version 3 or later"
assert "--enable-gpl" not in options
assert {"--enable-libx264", "--enable-libx265"} <= set(options)
assert held == ["libx264", "libx265"]
print("as described")
PYTHON
