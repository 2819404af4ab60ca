#!/usr/bin/env bash
# Guess: asyncio sends the answers of a server at once (TCP_NODELAY), whatever socket it listens on.
# Python's socket.create_server makes sockets of protocol 0, and asyncio sets TCP_NODELAY only where the protocol is
# IPPROTO_TCP. So uvicorn 0.54.0, given such a socket, answers each request on an open connection 40 ms later (Linux): head
# and body are two packets, and the second waits for the client's delayed acknowledgement.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet uvicorn==0.54.0
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import http.client
import importlib.metadata
import platform
import socket
import statistics
import threading
import time

import uvicorn


async def app(scope, receive, send):
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"2")]})
    await send({"type": "http.response.body", "body": b"ok"})


def median_ms(nodelay):
    listener = socket.create_server(("127.0.0.1", 0))
    if nodelay:
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    config = uvicorn.Config(app, http="h11", lifespan="off", log_level="critical")
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    client = http.client.HTTPConnection(*listener.getsockname())
    times = []
    for _ in range(40):
        began = time.perf_counter()
        client.request("GET", "/")
        assert client.getresponse().read() == b"ok"
        times.append(1000 * (time.perf_counter() - began))
    client.close()
    server.should_exit = True
    thread.join()
    return listener.proto, statistics.median(times)


print("Python", platform.python_version(), "uvicorn", importlib.metadata.version("uvicorn"))
proto, before = median_ms(False)
_, after = median_ms(True)
print(f"protocol of the socket: {proto}; IPPROTO_TCP is {socket.IPPROTO_TCP}")
print(f"median of an answer: {before:.1f} ms, with TCP_NODELAY on the listening socket {after:.1f} ms")
assert proto == 0
assert before > 30 > 3 * after
print("as described")
PYTHON
