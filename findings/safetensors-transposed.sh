#!/usr/bin/env bash
# safetensors 0.8.0: its NumPy writer stores the memory of an array, not its elements in order. A
# transposed array has the right shape in the file and the wrong elements, without an error. The
# writer for PyTorch refuses such a tensor. Written in the order of the elements (C), it is right.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.4.6 safetensors==0.8.0
"$folder/venv/bin/python" - <<'PYTHON'
import numpy as np
import safetensors
from safetensors.numpy import load, save

print("safetensors", safetensors.__version__, "numpy", np.__version__)
array = np.arange(6.0).reshape(2, 3)
back = load(save({"a": array.T}))["a"]
plain = load(save({"a": np.asarray(array.T, order="C")}))["a"]
print("written\n", array.T, "\nread\n", back, "\nread, written in order\n", plain)
assert back.shape == array.T.shape
assert not np.array_equal(back, array.T), "the writer has changed"
assert np.array_equal(plain, array.T)
PYTHON
