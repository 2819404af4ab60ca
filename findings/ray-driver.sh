#!/usr/bin/env bash
# Ray 2.60.0. A program that asks for no output of its cluster (`log_to_driver=False`,
# `logging_level=ERROR`) still gets messages about its machines, and they go to its stdout: two lines
# when a task's process ends and the task is tried again. Its result is right.
# Serve: `serve.ingress` takes a function that builds an application. A functools.partial of that
# function is taken for the application: it deploys as healthy, and every request gets status 500.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet 'ray[serve]==2.60.0' fastapi==0.165.0 urllib3==2.6.3
cd "$folder"
cat > retried.py <<'PYTHON'
import logging
import os
import time
from pathlib import Path

import ray

ray.init("local", num_cpus=1, log_to_driver=False, logging_level=logging.ERROR)


@ray.remote(max_retries=2)
def work(mark):
    if not mark.exists():
        mark.touch()
        os._exit(3)
    return 42


assert ray.get(work.remote(Path("mark").absolute())) == 42
time.sleep(2)
ray.shutdown()
PYTHON
"$folder/venv/bin/python" -W ignore retried.py > stdout 2> stderr
echo "ray $("$folder/venv/bin/python" -c 'import ray; print(ray.__version__)')"
echo "lines on stdout, though none was printed by the program:"
cut -c 1-110 stdout
test "$(grep -c raylet stdout)" -ge 1

cat > ingress.py <<'PYTHON'
from functools import partial

import ray
import urllib3
from fastapi import FastAPI
from ray import serve


def build(text):
    app = FastAPI()
    app.get("/")(lambda: text)
    return app


def by_function():
    return build("hello")


ray.init("local", num_cpus=2, log_to_driver=False, logging_level="ERROR")
serve.start(http_options={"port": 8377})
got = {}
for name, builder in (("function", by_function), ("partial", partial(build, "hello"))):
    serve.run(serve.deployment(serve.ingress(builder)()).bind(), name=name)
    state = serve.status().applications[name].status
    answer = urllib3.request("GET", "http://127.0.0.1:8377/", retries=False)
    got[name] = (str(state.value), answer.status)
    print(name, *got[name])
    serve.delete(name)
assert got == {"function": ("RUNNING", 200), "partial": ("RUNNING", 500)}, got
PYTHON
"$folder/venv/bin/python" -W ignore ingress.py 2> /dev/null
