#!/usr/bin/env bash
# Guess: the slices of a safetensors file behave as those of numpy, which may be empty anywhere.
# safetensors 0.8.0: an empty slice at the end of an array ([n:n]) raises an error, one before it is
# empty. Every slice of an array without elements raises, also [:]. get_tensor reads such an array.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.4.6 safetensors==0.8.0
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import numpy as np
import safetensors
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

arrays = {"five": np.arange(5), "none": np.zeros((0, 2))}
save_file(arrays, "a.safetensors")
file = safe_open("a.safetensors", "np")
print("safetensors", safetensors.__version__)
got = {}
for name, rows in (("five", slice(2, 2)), ("five", slice(5, 5)), ("none", slice(None))):
    try:
        got[name, str(rows)] = file.get_slice(name)[rows].shape
    except SafetensorError as error:
        got[name, str(rows)] = "error"
        print(error)
    print(name, rows, "numpy:", arrays[name][rows].shape, "safetensors:", got[name, str(rows)])
assert list(got.values()) == [(0,), "error", "error"]
assert file.get_tensor("none").shape == (0, 2)
print("as described")
PYTHON
