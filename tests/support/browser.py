"""A page in a headless Chromium, driven over the DevTools protocol."""

import base64
import contextlib
import io
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.viewing import SECONDS, wait
from websockets.sync.client import connect

OPTIONS = (
    "--headless=new",
    "--no-sandbox",  # tests may run as root, and open nothing but the page under test
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--remote-debugging-port=0",
    "--window-size=1000,700",
    # run WebGL on the CPU, so that no graphics card is needed
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


def find_chromium():
    """The path of Chromium; skips the test if there is none."""
    chromium = next(filter(None, map(shutil.which, NAMES)), None)
    if not chromium:
        pytest.skip("no chromium on PATH; apt install chromium")
    return chromium


class Page:
    """A tab. wrong: errors in its console; asked: addresses that it requested."""

    def __init__(self, socket):
        self.wrong, self.asked = [], []
        self._socket = socket

    def call(self, method, **parameters):
        """Call a method of the protocol; returns its result."""
        self._socket.send(json.dumps({"id": 1, "method": method, "params": parameters}))
        while "id" not in (message := json.loads(self._socket.recv(timeout=SECONDS))):
            kind, event = message["method"], message["params"]
            if kind == "Runtime.exceptionThrown" or event.get("type") == "error":
                self.wrong.append(event)
            if kind in ("Network.requestWillBeSent", "Network.webSocketCreated"):
                self.asked.append(event.get("url") or event["request"]["url"])
        return message["result"]

    def evaluate(self, expression):
        """The value of a JavaScript expression; waits for it if it is a promise."""
        reply = self.call(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in reply, reply
        return reply["result"].get("value")

    def open(self, address):
        """Bring the tab to the front and go to an address, noting requests and errors."""
        self.call("Page.bringToFront")  # a tab in the back paints no image
        for domain in ("Page", "Runtime", "Network"):
            self.call(f"{domain}.enable")
        self.call("Page.navigate", url=address)
        there = "location.href != 'about:blank' && document.readyState == 'complete'"
        wait(lambda: self.evaluate(there))

    def drag(self, start, moves):
        """Press the left button at `start`, move by each of `moves`, release."""

        def mouse(kind, **more):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", **more)

        x, y = start
        mouse("mousePressed", clickCount=1)
        for dx, dy in moves:
            x, y = x + dx, y + dy
            mouse("mouseMoved", buttons=1)
            time.sleep(0.02)
        mouse("mouseReleased", clickCount=1)

    def key(self, key):
        """Press a key."""
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, text=key)

    def screenshot(self):
        """(H, W, 3) uint8 image of the window."""
        return image_of("base64," + self.call("Page.captureScreenshot")["data"])


@contextlib.contextmanager
def new_page(address):
    """A Page at an address, in a browser with a profile of its own."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        words = [find_chromium(), *OPTIONS, f"--user-data-dir={profile}"]
        with subprocess.Popen(words, stderr=subprocess.DEVNULL) as process:
            try:
                port = Path(profile) / "DevToolsActivePort"
                wait(lambda: port.exists() and "\n" in port.read_text())
                place = f"http://127.0.0.1:{port.read_text().split()[0]}/json/new?about:blank"
                request = urllib.request.Request(place, method="PUT")
                with urllib.request.urlopen(request, timeout=SECONDS) as response:  # noqa: S310
                    tab = json.loads(response.read())["webSocketDebuggerUrl"]
                with connect(tab, max_size=None) as socket:
                    page = Page(socket)
                    page.open(address)
                    yield page
            finally:
                process.terminate()


def ask(file, script, fragment=""):
    """Run a script in a page after it has loaded; returns what the script returns.

    file: the page. script: body of a function. fragment: the end of the page's address, from # on.
    """
    with new_page(f"{file.as_uri()}{fragment}") as page:
        return page.evaluate(f"(async () => {{ {script} }})()")


def image_of(url):
    """(H, W, 3) uint8 image of a data URL of a PNG."""
    data = base64.b64decode(url.partition("base64,")[2])
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
