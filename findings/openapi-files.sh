#!/usr/bin/env bash
# Guess: a generated client sends a file where FastAPI takes an UploadFile.
# FastAPI 0.165.0 describes it by contentMediaType without `format: binary`. openapi-python-client 0.29.1 types that as str, and
# openapi-typescript 7.13.0 types both as string. An optional file (`UploadFile | None`) that is None is sent as the text "None".
# A File without a name is sent as a field, which Starlette gives as text. A field with a default is required in TypeScript.
# openapi-typescript takes any TypeScript that npm brings, and fails with version 7, which has no `ts.factory`.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet fastapi==0.165.0 pydantic==2.14.4 python-multipart==0.0.34 openapi-python-client==0.29.1
cd "$folder"
PATH="$folder/venv/bin:$PATH" python - <<'PYTHON'
import json
import subprocess
import sys
from typing import Annotated

from fastapi import FastAPI, Form, UploadFile
from pydantic import WithJsonSchema

sys.path.insert(0, ".")
BINARY = {"type": "string", "format": "binary"}


class Binary(UploadFile):
    @classmethod
    def __get_pydantic_json_schema__(cls, *_):
        return BINARY


app = FastAPI(generate_unique_id_function=lambda route: route.name)


@app.post("/plain")
def plain(file: UploadFile, other: UploadFile | None = None): ...


@app.post("/binary")
def binary(
    file: Binary,
    nullable: Binary | None = None,
    other: Annotated[Binary | None, WithJsonSchema(BINARY)] = None,
    names: Annotated[list[str], Form()] = [],
): ...


description = app.openapi()
json.dump(description, open("openapi.json", "w"))
bodies = description["components"]["schemas"]
stated = bodies["Body_plain"]["properties"]["file"]
print("FastAPI:", stated)
assert stated["contentMediaType"] == "application/octet-stream" and "format" not in stated
command = ["openapi-python-client", "generate", "--path", "openapi.json", "--meta", "none"]
subprocess.run([*command, "--output-path", "made"], check=True, capture_output=True)
from made.models import BodyBinary, BodyPlain
from made.types import File

print("type of a file:", BodyPlain.__annotations__["file"], "with format:", BodyBinary.__annotations__["file"])
assert (BodyPlain.__annotations__["file"], BodyBinary.__annotations__["file"]) == ("str", "File")
named = File(payload=b"x", file_name="x.jpg")
parts = dict(BodyBinary(file=named, nullable=None).to_multipart())
print("None is sent as:", parts["nullable"], "| unset:", "other" in parts)
assert parts["nullable"][1] == b"None"
assert "other" not in parts
name = File(payload=b"x").to_tuple()[0]
print("file name without one:", name)
assert name is None
PYTHON
if ! command -v npm > /dev/null; then
    echo "npm is not installed: TypeScript was not tried"
    exit 0
fi
npm install --silent --no-audit --no-fund openapi-typescript@7.13.0 typescript@5.9.3 > /dev/null
node_modules/.bin/openapi-typescript openapi.json --output made.ts > /dev/null
grep -A 30 "Body_binary: {" made.ts | grep -E "^ *(file|nullable|other|names)\??:"
grep -A 30 "Body_binary: {" made.ts | grep -q " file: string;"
grep -A 30 "Body_binary: {" made.ts | grep -q " names: string\[\];"
npm install --silent --no-audit --no-fund --force typescript@7.0.2 > /dev/null 2>&1
if node_modules/.bin/openapi-typescript openapi.json --output made.ts 2> error.txt; then exit 1; fi
grep -m1 TypeError error.txt
grep -q createKeywordTypeNode error.txt
echo "as described"
