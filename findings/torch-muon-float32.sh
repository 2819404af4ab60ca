#!/usr/bin/env bash
# torch.optim.Muon of PyTorch 2.13.0 iterates in bfloat16, also where parameters and gradients are float32.
# No argument changes it. Every number of a step is one of bfloat16, and the step differs from the same
# five iterations in float32. On a processor without bfloat16 products, which torch states by
# `_is_mkldnn_bf16_supported`, a step takes many times as long as in float32 (25 to 35 times on AVX2).
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.4.6 torch==2.13.0
cd "$folder"
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
import time

import torch

torch.manual_seed(0)
torch.set_num_threads(1)
A, B, C = 3.4445, -4.7750, 2.0315  # the published coefficients, Muon's default


def iterated(gradient: torch.Tensor) -> torch.Tensor:
    x = gradient / gradient.norm()
    for _ in range(5):
        square = x @ x.T
        x = A * x + (B * square + C * square @ square) @ x
    return x


matrix = torch.nn.Parameter(torch.zeros(256, 256))
gradient = torch.randn(256, 256)
muon = torch.optim.Muon([matrix], lr=1.0, weight_decay=0.0, momentum=0.0, nesterov=False)
matrix.grad = gradient
muon.step()
step = -matrix.detach()
coarse = bool((step.bfloat16().float() == step).all())
apart = float((step - iterated(gradient)).norm() / step.norm())


def seconds(call) -> float:
    call()
    start = time.process_time()
    for _ in range(5):
        call()
    return (time.process_time() - start) / 5


slower = seconds(muon.step) / seconds(lambda: iterated(gradient))
native = torch.ops.mkldnn._is_mkldnn_bf16_supported()
print("torch", torch.__version__, "| bfloat16 products in hardware:", native)
print("all numbers of a step are those of bfloat16:", coarse)
print(f"difference from the iteration in float32: {100 * apart:.1f} % of the step")
print(f"a step takes {slower:.1f} times as long as the iteration in float32")
assert coarse, "Muon no longer iterates in bfloat16"
assert native or slower > 5, "Muon is no longer slow without bfloat16 products"
PYTHON
