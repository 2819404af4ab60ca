#!/usr/bin/env bash
# Guess: `find` of a fsspec store raises if a folder cannot be listed, at least with on_error="raise".
# fsspec 2026.9.0: the folder is left out without a word. `walk` applies on_error to the first folder
# alone, and does not hand it on to those below.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet fsspec==2026.9.0
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import fsspec
from fsspec.implementations.memory import MemoryFileSystem
from fsspec.spec import AbstractFileSystem


class Broken(MemoryFileSystem):
    def ls(self, path, **options):
        if path.endswith("images"):
            raise ConnectionResetError("connection lost")
        return super().ls(path, **options)


print("fsspec", fsspec.__version__)
store = Broken()
store.pipe({"/room/scene.json": b"1", "/room/images/0.jpg": b"2"})
found = AbstractFileSystem.find(store, "/room")  # that of most stores
walked = [files for _, _, files in store.walk("/room", on_error="raise")]
print("find:", found, "walk:", walked)
assert found == ["/room/scene.json"]
assert walked == [["scene.json"]]
print("as described")
PYTHON
