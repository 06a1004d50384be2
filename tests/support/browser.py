"""A page in a headless Chromium, driven over the DevTools protocol."""

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
    # WebGL on the CPU, so that no graphics card is needed
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
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

    async def open(self, address):
        """Go to an address and to the front, with everything noted that happens there."""
        await self.call("Page.bringToFront")  # in the back no image is painted
        for domain in ("Page", "Runtime", "Log", "Network"):
            await self.call(f"{domain}.enable")
        await self.call("Page.navigate", url=address)
        for _ in range(SECONDS * 20):
            if await self.evaluate(
                "location.href != 'about:blank' && document.readyState == 'complete'"
            ):
                return
            await asyncio.sleep(0.05)
        raise AssertionError(f"never loaded; the console says {self.said}")

    async def drag(self, start, moves):
        """Press at a place, go along, release."""
        x, y = start
        await self._mouse("mousePressed", x, y, clickCount=1)
        for dx, dy in moves:
            x, y = x + dx, y + dy
            await self._mouse("mouseMoved", x, y, buttons=1)
            await asyncio.sleep(0.02)
        await self._mouse("mouseReleased", x, y, clickCount=1)

    async def key(self, key):
        """Press a key."""
        await self.call("Input.dispatchKeyEvent", type="keyDown", key=key, text=key)
        await self.call("Input.dispatchKeyEvent", type="keyUp", key=key)

    async def screenshot(self):
        """(H, W, 3) uint8 of the window."""
        found = await self.call("Page.captureScreenshot")
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(found["data"]))).convert("RGB"))

    async def _mouse(self, kind, x, y, **more):
        await self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", **more)

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


@contextlib.asynccontextmanager
async def new_page():
    """A Page of a browser with a profile of its own; skips the test where there is none."""
    program = find_chromium()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        process = await asyncio.create_subprocess_exec(
            program,
            *OPTIONS,
            f"--user-data-dir={profile}",
            stderr=asyncio.subprocess.PIPE,
            start_new_session=True,
        )
        reader = None
        try:
            place = await asyncio.wait_for(_place(process.stderr), SECONDS)
            reader = asyncio.create_task(process.stderr.read())  # so that its pipe stays empty
            address = await asyncio.to_thread(_new_tab, place)
            async with websockets.connect(address, max_size=None) as socket:
                yield Page(socket)
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


def _new_tab(place):
    """The address of a new tab's socket."""
    request = urllib.request.Request(f"http://{place}/json/new?about:blank", method="PUT")
    with urllib.request.urlopen(request, timeout=SECONDS) as response:  # noqa: S310
        return json.loads(response.read())["webSocketDebuggerUrl"]


def ask(file, script, fragment=""):
    """What a script returns that runs in a page after it has loaded.

    file: the page. script: the body of a function. fragment: of the page's address, from # on.
    """

    async def scenario():
        async with new_page() as page:
            await page.open(f"{file.as_uri()}{fragment}")
            return await page.evaluate(f"(async () => {{ {script} }})()")

    return asyncio.run(scenario())


def image_of(url):
    """(H, W, 3) uint8 image of a data URL of a PNG."""
    data = base64.b64decode(url.partition("base64,")[2])
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
