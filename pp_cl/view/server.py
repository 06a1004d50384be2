"""The server of the page of a run: a websocket for each tab, and the drawing for all of them."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections import deque
from typing import Any

from aiohttp import WSMsgType, web

from pp_cl.errors import UserError
from pp_cl.view.access import Access
from pp_cl.view.live_run import LiveRun
from pp_cl.view.messages import MOST_BYTES, ViewRequest, packed, read_request
from pp_cl.view.pages import application, runner

SCRIPTS = ("page.js", "curve.js")
SOCKET = "socket"  # its path
MOST_TABS = 16
POLL_SECONDS = 1.0  # between two looks at checkpoint and log
PULSE_SECONDS = 20.0  # a tab that answers no ping for so long is gone
RATE_SECONDS = 2.0  # of frames that the rate is counted over


class Tab:
    """A tab with its websocket; of messages that replace each other the newest is sent."""

    def __init__(self, socket: web.WebSocketResponse) -> None:
        self.socket = socket
        self._outbox: dict[str, str | bytes] = {}
        self._filled = asyncio.Event()
        self._drawn: deque[float] = deque(maxlen=240)

    def show(self, kind: str, facts: dict[str, Any], image: bytes) -> None:
        """Send a picture."""
        now = time.monotonic()
        self._drawn.append(now)
        recent = [t for t in self._drawn if now - t < RATE_SECONDS]
        rate = round((len(recent) - 1) / (now - recent[0]), 1) if len(recent) > 1 else None
        self._put(kind, packed(facts | {"per_second": rate}, image))

    def tell(self, kind: str, facts: dict[str, Any]) -> None:
        """Send facts as JSON, in place of unsent ones of this kind."""
        self._put(kind, json.dumps({"type": kind, **facts}, allow_nan=False))

    def _put(self, kind, message):
        self._outbox[kind] = message
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


class ViewServer:
    """Serves one run to the tabs of one access. drawn: number of pictures made."""

    def __init__(self, live: LiveRun, access: Access) -> None:
        self.live, self.access = live, access
        self.tabs: set[Tab] = set()
        self.drawn = 0
        self._told: dict[str, dict[str, Any]] = {"facts": live.facts()}  # what each tab knows
        # the newest request of each kind, oldest first; a replaced one keeps its place
        self._asked: dict[tuple[Tab, str], ViewRequest] = {}
        self._waits = asyncio.Event()  # is set where there are some

    def runner(self) -> web.AppRunner:
        """Runs the server, while draw() runs beside it."""
        routes = [web.get("/{token}/" + SOCKET, self._socket)]
        app = application(self.access, "page.html", SCRIPTS, routes, MOST_BYTES)
        app.on_shutdown.append(self._close_tabs)
        return runner(app)

    async def draw(self) -> None:
        """Draw for ever what tabs ask for, and tell them of new checkpoints and rows of the log:
        one thing at a time, in a thread, since the run has one device.
        """
        looked = -POLL_SECONDS
        while True:
            if time.monotonic() - looked >= POLL_SECONDS:
                self._tell(await asyncio.to_thread(self._look))
                looked = time.monotonic()
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._waits.wait(), POLL_SECONDS)
            if self._asked:
                (tab, kind), request = next(iter(self._asked.items()))
                del self._asked[tab, kind]
                await self._answer(tab, request)
            else:
                self._waits.clear()

    def _look(self):
        """{kind of message: facts} of what is new."""
        new = {}
        if self.live.refresh():
            new["facts"], around = self.live.facts(), self.live.surroundings()
            if around:
                new["surroundings"] = around
        if (rows := self.live.new_rows()) is not None:
            new["log"] = {"rows": rows}
        return new

    def _tell(self, new):
        self._told |= new
        for tab in self.tabs:
            for kind, facts in new.items():
                tab.tell(kind, facts)

    async def _answer(self, tab, request):
        try:
            facts, image = await asyncio.to_thread(self.live.draw, request)
        except UserError as error:
            tab.tell("refused", {"number": request.number, "line": str(error)})
            return
        self.drawn += 1
        tab.show(request.kind, facts, image)

    async def _socket(self, request):
        if len(self.tabs) >= MOST_TABS:
            raise web.HTTPServiceUnavailable(text=f"{MOST_TABS} tabs are open; close one\n")
        socket = web.WebSocketResponse(max_msg_size=MOST_BYTES, heartbeat=PULSE_SECONDS)
        await socket.prepare(request)
        tab = Tab(socket)
        self.tabs.add(tab)
        sender = asyncio.create_task(tab.send_all())
        try:
            for kind, facts in self._told.items():
                tab.tell(kind, facts)
            with contextlib.suppress(ConnectionError):  # of a pong to a tab that is gone
                async for message in socket:
                    if message.type is WSMsgType.TEXT:
                        self._ask(tab, message.data)
                    else:
                        tab.tell("refused", {"number": None, "line": "messages must be text"})
        finally:
            self.tabs.discard(tab)
            for key in [key for key in self._asked if key[0] is tab]:
                del self._asked[key]
            sender.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionError):
                await sender
        return socket

    def _ask(self, tab, text):
        try:
            request = read_request(text)
        except UserError as error:
            tab.tell("refused", {"number": None, "line": str(error)})
            return
        self._asked[tab, request.kind] = request
        self._waits.set()

    async def _close_tabs(self, _app):
        for tab in list(self.tabs):
            await tab.socket.close(code=1001, message=b"pp-cl view has ended")
