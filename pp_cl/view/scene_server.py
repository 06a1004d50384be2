"""The server of the page of a scene: its cameras and sparse points, and what the user changes about
them, which is written to the scene's folder.
"""

from __future__ import annotations

import asyncio
import base64
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from aiohttp import web
from PIL import Image

from pp_cl.config import configure, preset
from pp_cl.errors import UserError
from pp_cl.files.image import read_rgba
from pp_cl.files.untrusted import strict_json
from pp_cl.scene.camera_path import looked_at, up_of
from pp_cl.scene.edits import FILE, checked_edits, read_edits, write_edits
from pp_cl.scene.load import scene_box, scene_frames, scene_splits
from pp_cl.scene.readers.frame import frame_keys
from pp_cl.scene.sparse import sparse_points
from pp_cl.scene.views import Photograph
from pp_cl.view.access import Access
from pp_cl.view.pages import application, runner
from pp_cl.view.shown import encoded

SHOWN_POINTS = 20_000  # that a browser draws while it turns
SHOWN_SIDE = 640  # pixels of a photograph
MOST_BYTES = 2**20  # of a request: the names of some ten thousand views
WIDE = 0.3  # of the distance of the cameras, half the side of a box that nothing states


class ShownScene:
    """A scene with all its views, those among them that the user has dropped. Raises UserError as
    scene_frames does.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        names = sorted(scene_splits(folder), key=lambda split: split != "train")
        self.views: list[tuple[str, Photograph]] = [
            (split, one) for split in names for one in scene_frames(folder, split, edited=False)
        ]
        self._points, self._colours = sparse_points(folder)
        self._known = self._stored()

    @cached_property
    def _cameras(self):
        return [one.camera for _, one in self.views]

    def facts(self) -> dict[str, Any]:
        """What the page shows, JSON-able. box: of the user or the format, else a suggestion."""
        self._known = self._stored()
        edits, box = read_edits(self.folder), scene_box(configure(preset("tiny"), str(self.folder)))
        is_given, box = box is not None, self._suggested() if box is None else box
        step = 1 + len(self._points) // SHOWN_POINTS
        return {
            "name": self.folder.resolve().name,
            "file": FILE,
            "up": up_of(self._cameras).tolist(),
            "box": box.tolist(),
            "is_given": is_given,
            "points": _packed(self._points[::step], "<f4"),
            "colours": _packed(self._colours[::step], "u1"),
            "views": [
                {
                    "name": one.name,
                    "split": split,
                    "camera": frame_keys(one.camera),
                    "dropped": one.name in edits.dropped,
                }
                for split, one in self.views
            ],
        }

    def _stored(self):
        """The bytes of the edits, none where there is no file."""
        file = self.folder / FILE
        return file.read_bytes() if file.exists() else b""

    def _suggested(self):
        """(2, 3) box where nothing states one: of the sparse points near what the cameras look
        at, else around that.
        """
        middle = looked_at(self._cameras)
        distance = np.median([np.linalg.norm(c.eye - middle) for c in self._cameras])
        reach = WIDE * distance
        near = self._points[np.linalg.norm(self._points - middle, axis=1) < 2 * reach]
        if len(near):
            low, high = np.percentile(near, (2, 98), axis=0)
            if (high > low).all():
                return np.stack([low, high])
        return np.stack([middle - reach, middle + reach])

    def change(self, text: str) -> None:
        """Write the edits that a page sends, {"box", "dropped"}. Raises UserError for others, and
        where they cannot be written, or others than these have changed them meanwhile.
        """
        try:
            found = strict_json(text)
        except (ValueError, RecursionError):
            raise UserError("the message is no JSON of finite numbers; reload the page") from None
        edits = checked_edits(found, self.folder / FILE)
        kept = {split for split, one in self.views if one.name not in edits.dropped}
        if gone := {split for split, _ in self.views} - kept:
            raise UserError(f"no view of split {min(gone)} would be left; keep one")
        if self._stored() != self._known:
            raise UserError(f"{self.folder / FILE}: was changed meanwhile; reload the page")
        known = edits.dropped & {one.name for _, one in self.views}
        write_edits(self.folder, edits._replace(dropped=known, axes=read_edits(self.folder).axes))
        self._known = self._stored()

    def photograph(self, index: int) -> bytes:
        """JPEG file of a view, reduced. Raises UserError for a photograph that cannot be read."""
        image = Image.fromarray(read_rgba(self.folder / self.views[index][1].name))
        image.thumbnail((SHOWN_SIDE, SHOWN_SIDE))
        over = Image.new("RGBA", image.size, "white")
        return encoded(np.asarray(Image.alpha_composite(over, image).convert("RGB")), False)


def _packed(array, kind):
    return base64.b64encode(np.ascontiguousarray(array, kind)).decode()


class SceneServer:
    """Serves one scene to the tabs of one access."""

    def __init__(self, scene: ShownScene, access: Access) -> None:
        self.scene, self.access = scene, access
        self._one_at_a_time = asyncio.Lock()  # reads and writes of the scene's folder

    def runner(self) -> web.AppRunner:
        """Runs the server."""
        routes = [
            web.get("/{token}/scene.json", self._facts),
            web.get("/{token}/photograph/{index:[0-9]{1,6}}", self._photograph),
            web.post("/{token}/edits", self._change),
        ]
        return runner(application(self.access, "scene.html", ["scene.js"], routes, MOST_BYTES))

    async def draw(self) -> None:
        """The browser draws; waits for ever."""
        await asyncio.Event().wait()

    async def _facts(self, _request):
        return web.json_response(await self._done(self.scene.facts))

    async def _photograph(self, request):
        index = int(request.match_info["index"])
        if index >= len(self.scene.views):
            raise web.HTTPNotFound
        data = await self._done(self.scene.photograph, index)
        return web.Response(body=data, content_type="image/jpeg")

    async def _change(self, request):
        await self._done(self.scene.change, await request.text())
        return web.Response(status=204)

    async def _done(self, work, *values):
        """What a function of the scene returns, in a thread; its UserError is an answer."""
        async with self._one_at_a_time:
            try:
                return await asyncio.to_thread(work, *values)
            except UserError as error:
                raise web.HTTPBadRequest(text=str(error)) from None
