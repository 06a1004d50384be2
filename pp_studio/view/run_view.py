"""Shows a run: the model of its last checkpoint, or that of a training between its steps."""

import math
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from pp_cl import OnStep, RunFolder, Training, fastest, load
from pp_cl.engine import Device
from pp_cl.errors import UserError
from pp_studio.view.model_page import ModelPage, announce
from pp_studio.view.server import started

POLL = 1.0  # seconds between two looks at checkpoint and log
BREAK = 2.0  # times what a rendering took, in which a training is left alone: it gets two thirds
RENEWED = 1.0  # seconds after which a tab that rests sees the training's model again


class RunView:
    """Serves a run folder that another process may still train into. page: None while there is no
    checkpoint; told: of what is wrong, a line on the page. scene: where the run's is now. is_fast:
    it is shown as fastest() says.
    """

    def __init__(
        self,
        server: Any,
        dev: Device,
        folder: RunFolder,
        scene: str | None = None,
        *,
        is_fast: bool = False,
    ) -> None:
        self.page: ModelPage | None = None
        self.told = server.gui.add_markdown("")
        self._server, self._dev, self._folder, self._scene = server, dev, folder, scene
        self._is_fast = is_fast
        self._seen: dict[Any, Any] = {}  # by file: what differs when it is replaced or grows
        announce(server, f"reading {folder}")

    def serve(self) -> None:
        """Draw for ever what tabs want, and take up new checkpoints and rows of the log."""
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
        """Take up the checkpoint and the log where they have changed; no broken checkpoint."""
        if self._is_new(self._folder.checkpoint):
            try:
                self._take(load(self._folder.path, self._dev, scene=self._scene))
            except UserError as error:
                self.told.content = str(error)
        elif self.page is None and not self._folder.checkpoint.exists():
            self.told.content = f"{self._folder}: no checkpoint yet; waiting for the first one"
            announce(self._server, "waiting for the first checkpoint")
        if self.page and self._is_new(self._folder.log):
            self.page.set_rows(logged(self._folder))

    def _is_new(self, path):
        with suppress(OSError):
            stat, before = path.stat(), self._seen.get(path)
            self._seen[path] = stat.st_mtime_ns, stat.st_size, stat.st_ino
            return self._seen[path] != before

    def _take(self, run):
        line = ""
        if self._is_fast:
            if not self.page:
                announce(self._server, "measuring once which setting is fastest")
            run, line = fastest(run)
        self.told.content = line
        if self.page:
            self.page.take(run)
            return
        views = []
        try:
            views = run.scene("train").splits["train"]
        except UserError as error:
            self.told.content = f"no photographs: {error}"
        announce(self._server, "building kernels, which takes a while the first time")
        self.page = ModelPage(self._server, run, views)


def logged(folder: RunFolder) -> list[dict[str, Any]]:
    """The rows of a run's log, none of one that cannot be read."""
    with suppress(UserError):
        return folder.rows()
    return []


@contextmanager
def shown_training(training: Training) -> Iterator[tuple[str, OnStep]]:
    """Show a training until the block ends: (address, what to call after each step). Images are
    drawn there, between two steps, and leave the bits of the training as they are: they use the
    buffers that its previews use.
    """
    trainer, run = training.trainer, training.present_run()
    cameras = [view.camera for view in trainer.views]
    most = max(camera.width * camera.height for camera in cameras)  # what memory is planned for
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
            except Exception as error:  # of whatever kind: it is no reason to lose a training
                warnings.warn(f"nothing is shown any more: {error!r}", stacklevel=2)
                free = math.inf

        yield address, on_step
