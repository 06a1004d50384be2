"""A headless Chromium, driven over the DevTools protocol."""

import asyncio
import base64
import contextlib
import io
import json
import os
import re
import shutil
import signal
import tempfile
import urllib.request

import numpy as np
import pytest
import websockets
from PIL import Image

SECONDS = 60
OPTIONS = (
    "--headless=new",
    "--no-sandbox",  # tests may run as root, and open nothing but the page under test
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--no-default-browser-check",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--remote-debugging-port=0",
    "--window-size=1000,700",
)


NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


def find_chromium():
    """The program; skips the test where there is none."""
    found = next(filter(None, map(shutil.which, NAMES)), None)
    if not found:
        pytest.skip("no chromium on PATH; apt install chromium")
    return found


class Page:
    """A tab. said: what it wrote to the console, errors and warnings; asked: the addresses that it
    requested.
    """

    def __init__(self, socket):
        self.said, self.asked = [], []
        self._socket = socket
        self._answers = {}
        self._reader = asyncio.create_task(self._read())

    async def call(self, method, **parameters):
        """The result of a method of the protocol."""
        number = len(self._answers) + 1
        answer = self._answers[number] = asyncio.get_running_loop().create_future()
        message = {"id": number, "method": method, "params": parameters}
        await self._socket.send(json.dumps(message))
        return await asyncio.wait_for(answer, SECONDS)

    async def evaluate(self, expression):
        """The value of a JavaScript expression, or of what it promises."""
        found = await self.call(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    async def until(self, expression):
        """Wait until a JavaScript expression is true, which is returned."""
        for _ in range(SECONDS * 20):
            found = await self.evaluate(expression)
            if found:
                return found
            await asyncio.sleep(0.05)
        raise AssertionError(f"never: {expression}; the console says {self.said}")

    async def open(self, address):
        """Go to an address and to the front, with everything noted that happens there."""
        await self.call("Page.bringToFront")  # in the back no picture is painted
        for domain in ("Page", "Runtime", "Log", "Network"):
            await self.call(f"{domain}.enable")
        await self.call("Page.navigate", url=address)
        await self.until("location.href != 'about:blank' && document.readyState == 'complete'")

    async def mouse(self, kind, x, y, **more):
        """Send an event of the mouse at a place of the window."""
        await self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    async def drag(self, start, moves, button="left", pause=0.0):
        """Press at a place, go along, release."""
        held = {"left": 1, "right": 2}[button]
        x, y = start
        await self.mouse("mousePressed", x, y, button=button, buttons=held, clickCount=1)
        for dx, dy in moves:
            x, y = x + dx, y + dy
            await self.mouse("mouseMoved", x, y, button=button, buttons=held)
            await asyncio.sleep(pause)
        await self.mouse("mouseReleased", x, y, button=button, clickCount=1)

    async def key(self, key):
        """Press a key."""
        await self.call("Input.dispatchKeyEvent", type="keyDown", key=key, text=key)
        await self.call("Input.dispatchKeyEvent", type="keyUp", key=key)

    async def screenshot(self):
        """(H, W, 3) uint8 of the window."""
        found = await self.call("Page.captureScreenshot")
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(found["data"]))).convert("RGB"))

    async def _read(self):
        async for message in self._socket:
            event = json.loads(message)
            if "id" in event:
                self._answers[event["id"]].set_result(event.get("result", event))
            else:
                self._note(event["method"], event["params"])

    def _note(self, method, found):
        if method == "Runtime.consoleAPICalled":
            self.said.append(f"{found['type']} {[a.get('value') for a in found['args']]}")
        elif method == "Runtime.exceptionThrown":
            self.said.append(str(found["exceptionDetails"]))
        elif method == "Log.entryAdded":
            self.said.append(f"{found['entry']['text']} {found['entry'].get('url')}")
        elif method == "Network.requestWillBeSent":
            self.asked.append(found["request"]["url"])
        elif method == "Network.webSocketCreated":
            self.asked.append(found["url"])


class Browser:
    """A running browser."""

    def __init__(self, place):
        self._place = place

    @contextlib.asynccontextmanager
    async def page(self):
        """A new Page, closed at the end."""
        target = json.loads(await self._ask("new?about:blank", "PUT"))
        address = target["webSocketDebuggerUrl"]
        async with websockets.connect(address, max_size=None) as socket:
            yield Page(socket)
        await self._ask(f"close/{target['id']}", "GET")

    async def _ask(self, path, method):
        request = urllib.request.Request(f"http://{self._place}/json/{path}", method=method)

        def answer():
            with urllib.request.urlopen(request, timeout=SECONDS) as response:  # noqa: S310
                return response.read()

        return await asyncio.to_thread(answer)


@contextlib.asynccontextmanager
async def chromium(*options):
    """A Browser with a profile of its own; skips the test where there is none."""
    program = find_chromium()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        process = await asyncio.create_subprocess_exec(
            program,
            *OPTIONS,
            *options,
            f"--user-data-dir={profile}",
            stderr=asyncio.subprocess.PIPE,
            start_new_session=True,
        )
        reader = None
        try:
            place = await asyncio.wait_for(_place(process.stderr), SECONDS)
            reader = asyncio.create_task(process.stderr.read())  # so that its pipe stays empty
            yield Browser(place)
        finally:
            with contextlib.suppress(ProcessLookupError):
                if hasattr(os, "killpg"):
                    os.killpg(process.pid, signal.SIGKILL)  # the group that it leads
                else:
                    process.kill()
            await process.wait()
            if reader:
                await reader


async def _place(stream):
    """host:port of the DevTools, from what the browser says first."""
    said = []
    while line := (await stream.readline()).decode():
        found = re.search(r"DevTools listening on ws://([^/]+)/", line)
        if found:
            return found.group(1)
        said.append(line)
    raise AssertionError(f"chromium does not start: {''.join(said)[-2000:]}")
