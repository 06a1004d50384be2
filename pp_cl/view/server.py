"""The server of the page: its files, and one websocket for each tab."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import time
from collections import deque
from importlib.resources import files
from typing import Any

from aiohttp import WSMsgType, web
from aiohttp.http_exceptions import HttpProcessingError

from pp_cl.errors import UserError
from pp_cl.view.access import Access
from pp_cl.view.follow import LogFollower
from pp_cl.view.live_run import LiveRun
from pp_cl.view.messages import MOST_BYTES, Frame, read_request
from pp_cl.view.render_thread import RenderThread

FILES = {
    "": ("page.html", "text/html"),
    "page.css": ("page.css", "text/css"),
    "page.js": ("page.js", "text/javascript"),
    "camera.js": ("camera.js", "text/javascript"),
    "curve.js": ("curve.js", "text/javascript"),
    "frustums.js": ("frustums.js", "text/javascript"),
    "icon.svg": ("icon.svg", "image/svg+xml"),
}
SOCKET = "socket"  # its path
MOST_TABS = 16
LOG_SECONDS = 1.0  # between two looks at the log
GRACE_SECONDS = 1.0  # for requests in work when the server ends
PULSE_SECONDS = 20.0  # a tab that answers no ping for so long is gone
RATE_SECONDS = 2.0  # of frames that the rate is counted over


class SocketTab:
    """A tab with its websocket; of messages that replace each other the newest is sent.

    deliver() and refuse() are called by the render thread, the rest by the event loop.
    """

    def __init__(self, socket: web.WebSocketResponse) -> None:
        self.socket = socket
        self.rows_sent = (0, 0)  # (starts, rows) of the log
        self._loop = asyncio.get_running_loop()
        self._outbox: dict[Any, str | bytes] = {}
        self._filled = asyncio.Event()
        self._drawn: deque[float] = deque(maxlen=240)

    def deliver(self, frame: Frame) -> None:
        """As render_thread.Tab."""
        packed = frame.packed(per_second=self._rate())
        self._loop.call_soon_threadsafe(self.put, frame.kind, packed)

    def refuse(self, number: int, line: str) -> None:
        """As render_thread.Tab."""
        self._loop.call_soon_threadsafe(self.tell, "refused", {"number": number, "line": line})

    def tell(self, kind: str, facts: dict[str, Any]) -> None:
        """Send facts as JSON, in place of unsent ones of this kind."""
        self.put(kind, json.dumps({"type": kind, **facts}, allow_nan=False))

    def tell_log(self, log: LogFollower) -> None:
        """Send the rows of the log that this tab has not got, if there are any.

        The log may grow meanwhile: it is read in another thread.
        """
        starts, (starts_sent, sent) = log.starts, self.rows_sent
        first = sent if starts == starts_sent else 0
        rows = log.rows[first:]
        if rows or starts != starts_sent:
            message = {"type": "log", "first": first, "rows": rows}
            self.put(("log", starts, first), json.dumps(message, allow_nan=False))
        self.rows_sent = starts, first + len(rows)

    def put(self, key: Any, message: str | bytes) -> None:
        """Send a message, in place of an unsent one of the same key."""
        self._outbox[key] = message
        self._filled.set()

    async def send_all(self) -> None:
        """Send for ever what is put; waits while the tab is slow to read."""
        while True:
            await self._filled.wait()
            self._filled.clear()
            while self._outbox:
                message = self._outbox.pop(next(iter(self._outbox)))
                if isinstance(message, str):
                    await self.socket.send_str(message)
                else:
                    await self.socket.send_bytes(message)

    def _rate(self):
        """Frames per second of the last RATE_SECONDS, None for a lone frame."""
        now = time.monotonic()
        self._drawn.append(now)
        recent = [t for t in self._drawn if now - t < RATE_SECONDS]
        return round((len(recent) - 1) / (now - recent[0]), 1) if len(recent) > 1 else None


class ViewServer:
    """Serves one run to the tabs of one access. failed: gets the exception that ends the render
    thread, which is a bug. To be made inside a running event loop.
    """

    def __init__(self, live: LiveRun, access: Access) -> None:
        self.access = access
        self.tabs: set[SocketTab] = set()
        self.log = LogFollower(live.folder.log)
        self._loop = asyncio.get_running_loop()
        self.failed: asyncio.Future[None] = self._loop.create_future()
        self.thread = RenderThread(live, self._changed, self._fail)
        self._facts, self._surroundings = live.facts(), None
        self._files = {
            name: (files("pp_cl.view").joinpath(file).read_bytes(), kind)
            for name, (file, kind) in FILES.items()
        }

    def runner(self) -> web.AppRunner:
        """Runs the server; rendering begins with its setup() and ends with its cleanup()."""
        logger = logging.getLogger(__name__)
        logger.addFilter(_is_a_bug)
        return web.AppRunner(
            self._app(), access_log=None, logger=logger, shutdown_timeout=GRACE_SECONDS
        )

    def _app(self):
        app = web.Application(middlewares=[self._guard], client_max_size=MOST_BYTES)
        app.on_response_prepare.append(self._set_headers)
        app.cleanup_ctx.append(self._work)
        app.on_shutdown.append(self._close_tabs)
        app.router.add_get("/{token}/" + SOCKET, self._socket)
        app.router.add_get("/{token}/{name:[^/]*}", self._file)
        return app

    @web.middleware
    async def _guard(self, request, handler):
        host, origin = request.headers.get("Host", ""), request.headers.get("Origin")
        socket = "Upgrade" in request.headers
        refusal = self.access.refusal(request.path, host, origin, socket=socket)
        if refusal:
            raise web.HTTPForbidden(text=f"403: {refusal}\n")
        return await handler(request)

    async def _set_headers(self, request, response):
        response.headers.update(self.access.headers(request.headers.get("Host", "")))

    async def _file(self, request):
        if request.match_info["name"] not in self._files:
            raise web.HTTPNotFound
        body, kind = self._files[request.match_info["name"]]
        return web.Response(body=body, content_type=kind, charset="utf-8")

    async def _socket(self, request):
        if len(self.tabs) >= MOST_TABS:
            raise web.HTTPServiceUnavailable(text=f"{MOST_TABS} tabs are open; close one\n")
        socket = web.WebSocketResponse(max_msg_size=MOST_BYTES, heartbeat=PULSE_SECONDS)
        await socket.prepare(request)
        tab = SocketTab(socket)
        self.tabs.add(tab)
        self.thread.add(tab)
        sender = asyncio.create_task(tab.send_all())
        try:
            self._tell(tab)
            tab.tell_log(self.log)
            with contextlib.suppress(ConnectionError):  # of a pong to a tab that is gone
                async for message in socket:
                    if message.type is WSMsgType.TEXT:
                        self._request(tab, message.data)
                    else:
                        tab.tell("refused", {"number": None, "line": "messages must be text"})
        finally:
            self.tabs.discard(tab)
            self.thread.forget(tab)
            sender.cancel()
            await _ended(sender)
        return socket

    def _request(self, tab, text):
        try:
            self.thread.submit(tab, read_request(text))
        except UserError as error:
            tab.tell("refused", {"number": None, "line": str(error)})

    def _tell(self, tab):
        tab.tell("facts", self._facts)
        if self._surroundings:
            tab.tell("surroundings", self._surroundings)

    def _changed(self, facts, surroundings):
        """Called by the render thread."""
        self._loop.call_soon_threadsafe(self._take, facts, surroundings)

    def _take(self, facts, surroundings):
        self._facts, self._surroundings = facts, surroundings
        for tab in self.tabs:
            self._tell(tab)

    def _fail(self, error):
        """Called by the render thread."""
        self._loop.call_soon_threadsafe(self.failed.set_exception, error)

    async def _work(self, _app):
        self.thread.start()
        following = asyncio.create_task(self._follow_log())
        yield
        following.cancel()
        await asyncio.to_thread(self.thread.stop)

    async def _follow_log(self):
        while True:
            if await asyncio.to_thread(self.log.poll):
                for tab in self.tabs:
                    tab.tell_log(self.log)
            await asyncio.sleep(LOG_SECONDS)

    async def _close_tabs(self, _app):
        for tab in list(self.tabs):
            await tab.socket.close(code=1001, message=b"pp-cl view has ended")


def _is_a_bug(record):
    """Whether a record of the log is worth its traceback: broken HTTP of a stranger is not."""
    return not (record.exc_info and isinstance(record.exc_info[1], HttpProcessingError))


async def _ended(sender):
    """Wait for a task that was cancelled; that its tab is gone is no error of it."""
    with contextlib.suppress(asyncio.CancelledError, ConnectionError):
        await sender
