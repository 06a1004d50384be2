"""Shows a run: the model of its last checkpoint, or of a training between its steps."""

import math
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from pp_cl import OnStep, RunFolder, Training, load
from pp_cl.engine import Device
from pp_cl.errors import UserError
from pp_studio.view.model_page import ModelPage, announce
from pp_studio.view.server import plain, started

POLL = 1.0  # seconds between checks of checkpoint and log
BREAK = 2.0  # a training runs undisturbed for this many times a rendering: it gets two thirds
RENEWED = 1.0  # seconds until a resting tab shows the training's model again


class RunView:
    """Serves a run folder that another process may still train into. page: None until there is a
    checkpoint; told: a line on the page about what is wrong. scene: where the run's scene is now.
    """

    def __init__(
        self,
        server: Any,
        dev: Device,
        folder: RunFolder,
        scene: str | None = None,
    ) -> None:
        self.page: ModelPage | None = None
        self.told = server.gui.add_markdown("")
        self._server, self._dev, self._folder, self._scene = server, dev, folder, scene
        self._seen: dict[Any, Any] = {}  # {file: what changes when it is replaced or grows}
        announce(server, f"reading {folder}")

    def serve(self) -> None:
        """Draw forever what tabs request, and take up new checkpoints and rows of the log."""
        looked = -POLL
        while True:
            if time.monotonic() - looked >= POLL:
                self.look()
                looked = time.monotonic()
            if self.page is None:
                time.sleep(POLL)
            elif not self.page.draw_next():
                self.page.woken.wait(0.1)

    def look(self) -> None:
        """Take up the checkpoint, unless it is broken, and the log if they have changed."""
        if self._is_new(self._folder.checkpoint):
            try:
                self._take(load(self._folder.path, self._dev, scene=self._scene))
            except UserError as error:
                self.told.content = plain(str(error))
        elif self.page is None and not self._folder.checkpoint.exists():
            where = plain(str(self._folder))
            self.told.content = f"{where}: no checkpoint yet; waiting for the first one"
            announce(self._server, "waiting for the first checkpoint")
        if self.page and self._is_new(self._folder.log):
            self.page.set_rows(logged(self._folder))

    def _is_new(self, path):
        with suppress(OSError):
            stat, before = path.stat(), self._seen.get(path)
            self._seen[path] = stat.st_mtime_ns, stat.st_size, stat.st_ino
            return self._seen[path] != before

    def _take(self, run):
        self.told.content = ""
        if self.page:
            self.page.take(run)
            return
        views = []
        try:
            views = run.scene("train").splits["train"]
        except UserError as error:
            self.told.content = f"no photographs: {plain(str(error))}"
        announce(self._server, "building kernels, which takes a while the first time")
        self.page = ModelPage(self._server, run, views)


def logged(folder: RunFolder) -> list[dict[str, Any]]:
    """The rows of a run's log; none if it cannot be read."""
    with suppress(UserError):
        return folder.rows()
    return []


@contextmanager
def shown_training(training: Training) -> Iterator[tuple[str, OnStep]]:
    """Show a training until the block ends: yields (address, a function to call after each step).
    That function draws images between two steps, in the buffers of the training's previews, so the
    bits of the training do not change.
    """
    trainer, run = training.trainer, training.present_run()
    cameras = [view.camera for view in trainer.views]
    most = max(camera.width * camera.height for camera in cameras)  # memory is planned for these
    with started(training.folder.name) as (server, address):
        page = ModelPage(server, run, trainer.views, most_pixels=most, is_training=True)
        page.tell("the first step builds kernels")
        announce(server, "the first step builds kernels")
        rows, free, renewed = logged(training.folder), 0.0, 0.0
        page.set_rows(rows)

        def on_step(step: int, row: dict[str, Any] | None) -> None:
            nonlocal free, renewed
            run.config, run.header["step"], start = training.config, step, time.monotonic()
            if row:
                rows.append(row)
                page.set_rows(rows)
            if start < free:
                return
            if start >= renewed + RENEWED:
                page.renew()
                renewed = start
            try:
                if page.draw_next():
                    end = time.monotonic()
                    free = end + BREAK * (end - start)
            except Exception as error:  # any error: none may end a training
                warnings.warn(f"nothing is shown any more: {error!r}", stacklevel=2)
                free = math.inf

        yield address, on_step
