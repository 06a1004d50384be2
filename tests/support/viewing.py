"""The server of `pp-cl view` in this process, and a tab without a browser."""

import asyncio
import contextlib
import io
import json
import socket

import aiohttp
import numpy as np
from aiohttp import WSMsgType, web
from PIL import Image

from pp_cl.scene.readers.frame import frame_keys
from pp_cl.view.access import Access
from pp_cl.view.live_run import LiveRun
from pp_cl.view.server import ViewServer

SECONDS = 60  # that an answer may take on a machine that does other things, too


def asking(camera, **changes):
    """A request for a camera's picture, as the page writes it."""
    facts = camera if isinstance(camera, dict) else frame_keys(camera)
    request = {"number": 1, "kind": "frame", "show": "colour", "draft": False, "camera": facts}
    return request | {"early_stop": 0.01, "kept": 1, "exposure": 0} | changes


def decoded(data):
    """(H, W, 3) int array of an image file."""
    return np.array(Image.open(io.BytesIO(data)).convert("RGB")).astype(int)


class Client:
    """A tab: its websocket, and the last message of each type that it got."""

    def __init__(self, socket):
        self.socket = socket
        self.last = {}

    async def receive(self, kind):
        """The next message of a type; (facts, file) of a frame or snapshot."""
        while True:
            message = await asyncio.wait_for(self.socket.receive(), SECONDS)
            if message.type is WSMsgType.BINARY:
                length = int.from_bytes(message.data[:4], "little")
                found = json.loads(message.data[4 : 4 + length]), message.data[4 + length :]
                self.last[found[0]["type"]] = found
            elif message.type is WSMsgType.TEXT:
                found = json.loads(message.data)
                self.last[found["type"]] = found
            else:
                raise ConnectionError(f"{message.type} {message.data}")
            if (found[0] if isinstance(found, tuple) else found)["type"] in kind.split():
                return found

    async def ask(self, camera, **changes):
        """(facts, image) of a request."""
        await self.socket.send_str(json.dumps(asking(camera, **changes)))
        facts, data = await self.receive(changes.get("kind", "frame"))
        return facts, decoded(data)


class Served:
    """A ViewServer that listens."""

    def __init__(self, server, access, session):
        self.server = server
        self.access = access
        self.session = session

    @property
    def origin(self):
        return f"http://127.0.0.1:{self.access.port}"

    def tab(self, **headers):
        """Context manager of the websocket of a tab."""
        headers = {"Origin": self.origin} | headers
        return self.session.ws_connect(f"{self.access.address}socket", headers=headers)

    async def ready(self, socket):
        """The Client of a websocket, when the model is loaded."""
        client = Client(socket)
        await client.receive("surroundings")
        return client


@contextlib.asynccontextmanager
async def served(dev, folder, stand_in=lambda live: live):
    """Served for the run in a folder. stand_in: what is drawn with, of the LiveRun."""
    with contextlib.closing(socket.create_server(("127.0.0.1", 0))) as listening:
        access = Access("127.0.0.1", listening.getsockname()[1])
        server = ViewServer(stand_in(LiveRun(dev, folder)), access)
        runner = server.runner()
        await runner.setup()
        drawing = asyncio.create_task(server.draw())
        try:
            await web.SockSite(runner, listening).start()
            async with aiohttp.ClientSession() as session:
                yield Served(server, access, session)
        finally:
            await runner.cleanup()
            drawing.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await drawing
