"""Clients that public generators make from `/openapi.json` locate, calibrate and read an error.

The packages for TypeScript are those below the folder in the variable NODE_PATH:

    npm install --prefix DIR openapi-typescript@7.13.0 openapi-fetch@0.17.0 typescript@5.9.3
    NODE_PATH=DIR/node_modules python -m pytest tests/service/test_generated_clients.py
"""

from __future__ import annotations

import importlib
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs" / "serve.md"
NODE_MODULES = Path(os.environ.get("NODE_PATH", "none"))
ADDRESS = "http://127.0.0.1:8000"

CALIBRATE = """
export async function calibrate(images: Blob[]) {
  const { data, error } = await client.POST("/calibrations", { body: { images } });
  if (error) throw new Error(error.error);
  const used: boolean[] = data.images.map((image) => image.used);
  return [data.mount, used.length, used[0]];
}
"""
RUN = """
import { readFileSync } from "node:fs";
import { calibrate, locate } from "./use.js";

const image = new File([readFileSync("image.jpg")], "image.jpg");
const answer = await locate(image);
console.log(answer.status, answer.base_from_camera.translation_m);
console.log(...(await calibrate([image])));
await locate(new File(["x"], "broken.jpg")).catch((error) => console.log(error.message));
"""


def block(kind: str, number: int = 0) -> str:
    """A block of code on the page of the service, by its language."""
    text = PAGE.read_text(encoding="utf-8").partition("## Generated clients")[2]
    return re.findall(rf"```{kind}\n(.*?)```", text, re.S)[number]


def test_a_generated_python_client(hall_service, image, tmp_path, monkeypatch, capsys):
    pytest.importorskip("openapi_python_client")
    (tmp_path / "openapi.json").write_bytes(hall_service.get("/openapi.json").body)
    words = ["generate", "--path", "openapi.json", "--meta", "none"]
    command = [sys.executable, "-m", "openapi_python_client", *words]
    done = subprocess.run(
        [*command, "--output-path", "evercal_client"],
        cwd=tmp_path, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert "Unable to parse" not in done.stdout + done.stderr
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    shutil.copy(image, "image.jpg")
    exec(block("python").replace(ADDRESS, hall_service.url), {})
    assert capsys.readouterr().out.startswith("[")  # only printed if ok
    api = importlib.import_module("evercal_client.api.images.localize")
    models = importlib.import_module("evercal_client.models")
    types = importlib.import_module("evercal_client.types")
    calibrate = importlib.import_module("evercal_client.api.images.calibrate")
    photo = types.File(payload=image.read_bytes(), file_name="hall.png")
    broken = types.File(payload=b"x", file_name="broken.jpg")
    package = importlib.import_module("evercal_client")
    with package.Client(hall_service.url) as client:
        body = models.BodyCalibrate(images=[photo])
        calibration = calibrate.sync(client=client, body=body)
        problem = api.sync(client=client, body=models.BodyLocalize(image=broken))
    assert calibration.mount == "eye_to_hand"
    assert calibration.images[0].used
    assert problem.error.startswith("broken.jpg: not a readable image")


@pytest.mark.skipif(
    not (NODE_MODULES / "openapi-fetch").is_dir(),
    reason="NODE_PATH lacks openapi-fetch",
)
def test_a_generated_typescript_client(hall_service, image, tmp_path):
    shutil.copy(image, tmp_path / "image.jpg")
    (tmp_path / "node_modules").symlink_to(NODE_MODULES)
    (tmp_path / "package.json").write_text('{"type": "module"}')
    lib = ["es2022", "dom", "dom.iterable"]
    options = {"module": "nodenext", "target": "es2022", "strict": True, "lib": lib}
    config = {"compilerOptions": {**options, "types": []}, "files": ["use.ts"]}
    (tmp_path / "tsconfig.json").write_text(json.dumps(config))
    for name, text in (
        ("types.mjs", block("js")),
        ("use.ts", block("ts") + CALIBRATE),
        ("run.mjs", RUN),
    ):
        (tmp_path / name).write_text(text.replace(ADDRESS, hall_service.url))

    def run(*command: str) -> str:
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        assert not done.returncode, done.stdout + done.stderr
        return done.stdout

    run("node", "types.mjs")
    run("node", "node_modules/typescript/bin/tsc")
    answer, mount, error = run("node", "run.mjs").splitlines()
    assert answer.startswith("ok [")
    assert mount == "eye_to_hand 1 true"
    assert (
        error
        == "broken.jpg: not a readable image (1 bytes); send PNG, JPEG, BMP, TIFF or WebP"
    )
