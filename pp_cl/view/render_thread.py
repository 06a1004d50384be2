"""One thread that draws for all tabs; of each tab the newest request wins."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Protocol

from pp_cl.errors import UserError
from pp_cl.view.live_run import LiveRun
from pp_cl.view.messages import Frame, ViewRequest

POLL_SECONDS = 1.0  # between two looks at the checkpoint


class Tab(Protocol):
    """Who asks for pictures; called from the render thread."""

    def deliver(self, frame: Frame) -> None:
        """Take the answer to a request."""

    def refuse(self, number: int, line: str) -> None:
        """Take one line in place of the answer to a request."""


class RenderThread:
    """Draws with a LiveRun, which it alone uses from start() on.

    on_change(facts, surroundings): called with those of the LiveRun when they changed. on_failure:
    called with an exception that ends the thread, which is a bug. Both and the methods of a Tab are
    called from this thread. drawn: number of pictures made.
    """

    def __init__(
        self,
        live: LiveRun,
        on_change: Callable[[dict, dict | None], None],
        on_failure: Callable[[BaseException], None],
    ) -> None:
        self.live = live
        self.drawn = 0
        self._on_change = on_change
        self._on_failure = on_failure
        self._pending: dict[tuple[Tab, str], ViewRequest] = {}
        self._tabs: set[Tab] = set()
        self._condition = threading.Condition()
        self._stopping = False
        self._thread = threading.Thread(target=self._work, name="pp-cl view", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End after the picture in work."""
        with self._condition:
            self._stopping = True
            self._condition.notify()
        self._thread.join()

    def add(self, tab: Tab) -> None:
        """Draw for a tab from now on."""
        with self._condition:
            self._tabs.add(tab)

    def forget(self, tab: Tab) -> None:
        """Draw for a tab no more; an answer in work is thrown away."""
        with self._condition:
            self._tabs.discard(tab)
            for key in [key for key in self._pending if key[0] is tab]:
                del self._pending[key]

    def submit(self, tab: Tab, request: ViewRequest) -> None:
        """Ask for a picture, in place of an older request of the tab for the same kind. Tabs take
        turns: a replaced request keeps its place in the queue.
        """
        with self._condition:
            if tab in self._tabs:
                self._pending[tab, request.kind] = request
                self._condition.notify()

    def _work(self):
        try:
            looked = -POLL_SECONDS
            while not self._stopping:
                if time.monotonic() - looked >= POLL_SECONDS:
                    if self.live.refresh():
                        self._on_change(self.live.facts(), self.live.surroundings())
                    looked = time.monotonic()
                job = self._next()
                if job:
                    self._draw(*job)
        except Exception as error:
            self._on_failure(error)

    def _next(self):
        """The oldest (tab, request), or None after POLL_SECONDS without one."""
        with self._condition:
            if not self._pending and not self._stopping:
                self._condition.wait(POLL_SECONDS)
            if not self._pending or self._stopping:
                return None
            key = next(iter(self._pending))
            return key[0], self._pending.pop(key)

    def _draw(self, tab, request):
        answer = refusal = None
        try:
            answer = self.live.draw(request)
            self.drawn += 1
        except UserError as error:
            refusal = str(error)
        with self._condition:
            wanted = tab in self._tabs
        if wanted and answer:
            tab.deliver(answer)
        elif wanted:
            tab.refuse(request.number, refusal)
