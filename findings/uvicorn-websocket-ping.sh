#!/usr/bin/env bash
# Guess: a websocket client that answers every ping stays connected, however slowly the application takes its messages.
# uvicorn 0.54.0 (websockets-sansio): while one message waits for the application, the connection is not read. The answer to
# a ping waits behind it, and the client is closed with 1011 "keepalive ping timeout"..
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet uvicorn==0.54.0 websockets==16.1.1
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import asyncio
import importlib.metadata

import uvicorn
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed


async def slow(scope, receive, send):
    """Accept, and take the next message after three seconds."""
    await receive()
    await send({"type": "websocket.accept"})
    while (await receive())["type"] == "websocket.receive":
        await asyncio.sleep(3)


async def closed_with(messages):
    server = uvicorn.Server(
        uvicorn.Config(slow, port=0, ws="websockets-sansio", ws_ping_interval=0.5,
                       ws_ping_timeout=0.5, lifespan="off", log_level="critical")
    )
    serving = asyncio.create_task(server.serve())
    while not server.started:
        await asyncio.sleep(0.05)
    port = server.servers[0].sockets[0].getsockname()[1]
    code = None
    async with connect(f"ws://127.0.0.1:{port}", ping_interval=None) as client:
        try:
            for _ in range(messages):
                await client.send(b"x")
                await asyncio.sleep(0.1)
            await asyncio.wait_for(client.recv(), 2.5)
        except ConnectionClosed as error:
            code = (error.rcvd.code, error.rcvd.reason)
        except TimeoutError:
            code = "open"
    server.should_exit = True
    await serving
    return code


for name in ("uvicorn", "websockets"):
    print(name, importlib.metadata.version(name))
one = asyncio.run(closed_with(1))
two = asyncio.run(closed_with(2))
print("one message:", one, "two messages:", two)
assert one == "open"
assert two == (1011, "keepalive ping timeout")
print("as described")
PYTHON
