"""A tab of the viewer without a browser: exchanges viser's messages over a websocket."""

import contextlib
import io
import threading
import time

import msgspec
import numpy as np
import viser
import zstandard
from PIL import Image
from scipy.spatial.transform import Rotation
from support.scenes import ring_cameras
from websockets.sync.client import connect

SECONDS = 60  # for an answer, which may be slow on a busy machine


class Tab:
    """A tab. handles: {label of a switch or button: its message}; nodes: {name: its message}, both
    as the server sent them.
    """

    def __init__(self, socket):
        self.handles, self.nodes = {}, {}
        self._socket, self._unread = socket, []

    def send(self, kind, **fields):
        """Send a message."""
        self._socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def look(self, camera, space=None):
        """Give the tab another camera's place and pixels. space: of the page."""
        position = space.page(camera.eye) if space else camera.eye
        self.send(
            "ViewerCameraMessage",
            wxyz=np.roll(Rotation.from_matrix(camera.pose[:, :3]).as_quat(), 1).tolist(),
            position=position.tolist(),
            fov=float(2 * np.arctan(camera.height / 2 / camera.fy)),
            near=0.01,
            far=1000.0,
            image_height=camera.height,
            image_width=camera.width,
            look_at=[0.0, 0.0, 0.0],
            up_direction=[0.0, 0.0, 1.0],
        )

    def set(self, label, value):
        """Set a switch; True presses a button."""
        self.send("GuiUpdateMessage", uuid=self.handles[label]["uuid"], updates={"value": value})

    def receive(self, kind, accept=lambda _message: True):
        """Wait for the next message of type `kind` that accept() takes; returns it."""
        deadline = time.monotonic() + SECONDS
        while True:
            while self._unread:
                message = self._unread.pop(0)
                if message["type"] == kind and accept(message):
                    return message
            self._read(deadline - time.monotonic())

    def image(self, accept=lambda _image: True):
        """The next background image that accept() takes, (H, W, 3) int."""
        images = []

        def take(message):
            image = Image.open(io.BytesIO(message["rgb_data"])).convert("RGB")
            images.append(np.array(image).astype(int))
            return accept(images[-1])

        self.receive("BackgroundImageMessage", take)
        return images[-1]

    def file(self):
        """(name, content) of the next file that the server sends."""
        name = self.receive("FileTransferStartDownload")["filename"]
        return name, self.receive("FileTransferPart")["content"]

    def _read(self, seconds):
        data = self._socket.recv(timeout=max(seconds, 0.01))
        length = int.from_bytes(data[8:16], "little")
        inner = zstandard.ZstdDecompressor().decompress(data[16 : 16 + length])
        for message in msgspec.msgpack.decode(inner)["messages"]:
            if "label" in (props := message.get("props") or {}) and "uuid" in message:
                self.handles[props["label"]] = message
            elif "name" in message and props:
                self.nodes[message["name"]] = message
            self._unread.append(message)


@contextlib.contextmanager
def tab(address):
    """A Tab of the server at an address, once it has received the whole page."""
    place, version = address.replace("http", "ws"), f"viser-v{viser.__version__}"
    with connect(place, subprotocols=[version], max_size=None, compression=None) as socket:
        opened = Tab(socket)
        opened.receive("ReplayDoneMessage")
        opened.look(ring_cameras(1, 32)[0])  # until then viser ignores the tab
        yield opened


def wait(condition):
    """Wait until condition() holds."""
    deadline = time.monotonic() + SECONDS
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@contextlib.contextmanager
def drawing(page):
    """Draw the images that a ModelPage's tabs ask for, in a thread, until the block ends."""
    done = threading.Event()

    def draw():
        while not done.is_set():
            if not page.draw_next():
                page.woken.wait(0.02)

    thread = threading.Thread(target=draw)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
