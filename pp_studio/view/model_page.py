"""The page of a model: renderings for each tab's camera, training views as frustums, switches, a
path of cameras, and the training's curve.

viser's threads only note what tabs request; draw_next() draws it in the thread with the device.
"""

import io
import json
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from pp_cl import Camera, Run
from pp_cl.engine import MIN_SIDE, View
from pp_cl.errors import UserError
from pp_cl.scene import frame_keys, up_of
from pp_studio.camera_path import through
from pp_studio.export.gaussians import CONSTANT, kept_gaussians
from pp_studio.view.drawing import DARK, OWN_CAMERA, SHOWN, draw
from pp_studio.view.server import plain, switches
from pp_studio.view.space import CHOSEN, FRUSTUM, Space, thumbnail

STILL = 0.2  # seconds without movement until the full resolution is drawn
DRAFT = 4  # a draft, while the camera moves, has this many times fewer pixels each way
SLOW = 0.25  # if a draft takes more seconds, the browser draws the fitted Gaussians instead
WAITING = "/waiting"  # the label in the middle of a page that shows no image yet
WHITE = np.full((1, 1, 3), 255, np.uint8)
MOST_PIXELS = 2**23  # most pixels of a rendering
FPS = 30  # frame rate of a path, as in `pp-cl render`
MOST_ROWS = 500  # most rows of the curve
LOGGED = ("step", "psnr", "loss")
BLUE, ORANGE, GREY = "#7fb4ff", "#ffb86b", "#a0a4ab"


@dataclass
class Tab:
    """A tab of a browser: its camera, in the tab's pixels; when (time.monotonic()) the camera or a
    switch last changed; when the last draft and the last full-size rendering were drawn. splat: the
    handle of the Gaussians that its browser draws, if the run has any.
    """

    client: Any
    camera: Camera
    moved: float = 0.0
    drafted: float = 0.0
    drawn: float = 0.0
    splat: Any = None


class _MovedError(Exception):
    """Raised when a rendering is no longer wanted."""


class ModelPage:
    """run: from the last take(). views: its training views, empty if the photographs are gone.
    most_pixels: of a rendering. is_training: the model changes while it is shown, and there is no
    memory for a copy. woken: set when a tab requests something.
    """

    def __init__(
        self,
        server: Any,
        run: Run,
        views: list[View],
        *,
        most_pixels: int = MOST_PIXELS,
        is_training: bool = False,
    ) -> None:
        self.run, self.woken = run, threading.Event()
        self._server, self._views, self._most_pixels = server, views, most_pixels
        self._tabs: dict[int, Tab] = {}
        self._wanted: list[Tab] = []  # tabs that want a PNG file
        self._keys: list[Camera] = []  # cameras of the path
        self._space = Space(*run.ball)
        cameras = [view.camera for view in views] or run.cameras("train")
        self._is_drawn = False  # whether any tab has an image
        self._took = 0.0  # seconds that the last draft took
        self._splat = None if is_training else self._gaussians()
        server.scene.set_up_direction(up_of(cameras))
        self._space.look_through(cameras[0], server.initial_camera)
        # a tab that looks through a frustum shows the model, not the photograph in the frustum
        server.initial_camera.near = 1.1 * FRUSTUM
        self._frustums = server.scene.add_frame("/views", show_axes=False)
        images: list[Any] = [thumbnail(view.image) for view in views] or [None] * len(cameras)
        for i, (camera, image) in enumerate(zip(cameras, images, strict=True)):
            frustum = self._space.add_frustum(server, f"/views/{i}", camera, image=image)
            frustum.on_click(
                lambda event, c=camera: self._space.look_through(c, event.client.camera)
            )
        self._status = server.gui.add_markdown("")
        with switches(server):
            self._add_switches(run.config.raster.early_stop, is_training)
        server.on_client_connect(self._connected)
        server.on_client_disconnect(self._disconnected)

    def _add_switches(self, early_stop, is_training):
        gui = self._server.gui
        self._show = gui.add_dropdown("Show", SHOWN, hint="keys 1 to 7")
        for i, show in enumerate(SHOWN):
            command = gui.add_command(f"Show {show}", hotkey=str(i + 1))
            command.on_trigger(lambda _, show=show: setattr(self._show, "value", show))

        def slider(name, least, most, step, value, **options):
            return gui.add_slider(
                name, min=least, max=most, step=step, initial_value=value, **options
            )

        self._exposure = slider("Brightness", -3.0, 3.0, 0.1, 0.0, hint="in stops")
        self._shown = gui.add_checkbox(
            "Photographs", True, hint="where they were taken; click one to go there"
        )
        gui.add_button("Save image").on_click(self._with_tab(self._want_file))
        with gui.add_folder("Camera path", expand_by_default=False):
            gui.add_button("Add this camera").on_click(self._with_tab(self._add_key))
            gui.add_button("Remove the last").on_click(self._remove_key)
            self._seconds = slider("Seconds", 1, 60, 1, 4)
            gui.add_button("Save path.json").on_click(self._with_tab(self._send_path))
        with gui.add_folder("For experts", expand_by_default=False):
            self._stop = slider("Early stop", 0.0, 0.5, 0.001, early_stop, hint="raster.early_stop")
            self._share = slider(
                "Points shown, %", 1, 100, 1, 100, hint="the most opaque", visible=not is_training
            )
            first = [(knob, knob.value) for knob in (self._stop, self._share, self._exposure)]
            gui.add_button("Reset").on_click(
                lambda _: [setattr(handle, "value", value) for handle, value in first]
            )
        for handle in (self._show, self._shown, *(knob for knob, _ in first)):
            handle.on_update(self._switched)
        series = [{"label": "step"}, {"label": "PSNR", "scale": "dB", "stroke": BLUE}]
        series.append({"label": "loss", "scale": "loss", "stroke": ORANGE})
        axes = [{"stroke": GREY}, {"scale": "dB", "stroke": BLUE}]
        axes.append({"scale": "loss", "stroke": ORANGE, "side": 1})  # 1: on the right
        self._curve = gui.add_uplot(
            tuple(np.zeros((len(LOGGED), 0))),
            tuple(series),
            scales={"x": {"time": False}, "dB": {}, "loss": {"distr": 3}},  # 3: logarithmic
            axes=tuple(axes),
            aspect=1.5,
            visible=False,
        )

    # ---- what viser's threads call

    async def _connected(self, client):
        async def moved(handle):
            if camera := self._space.camera(handle):
                tab = self._tabs.get(client.client_id)
                if tab is None:
                    tab = self._tabs[client.client_id] = Tab(client, camera)
                    if self._splat:  # the browser draws it until a rendering arrives
                        client.scene.set_background_image(WHITE)
                        tab.splat = client.scene.add_gaussian_splats("/splat", **self._splat)
                tab.camera, tab.moved = camera, time.monotonic()
                splat = self._by_browser(tab)
                if splat and not splat.visible:
                    splat.visible = True
                    client.scene.set_background_image(WHITE)
                self.woken.set()

        client.camera.on_update(moved)
        await moved(client.camera)

    def _by_browser(self, tab):
        """The Gaussians that the tab's browser draws while its camera moves, or None."""
        is_wanted = self._took > SLOW and self._show.value == SHOWN[0]
        return tab.splat if is_wanted else None

    async def _disconnected(self, client):
        self._tabs.pop(client.client_id, None)

    def _with_tab(self, act):
        """An event handler that calls act(tab) with the event's tab."""
        return lambda event: act(tab) if (tab := self._tabs.get(event.client_id)) else None

    def _switched(self, _event):
        self._frustums.visible = self._shown.value and self._show.value not in OWN_CAMERA
        for tab in list(self._tabs.values()):
            tab.moved = time.monotonic()
        self.woken.set()

    def _want_file(self, tab):
        self._wanted.append(tab)
        self.woken.set()

    def _add_key(self, tab):
        self._keys.append(self._camera(tab))
        name = f"/path/{len(self._keys)}"
        self._space.add_frustum(self._server, name, self._keys[-1], color=CHOSEN)

    def _remove_key(self, _event):
        if self._keys:
            self._server.scene.remove_by_name(f"/path/{len(self._keys)}")
            self._keys.pop()

    def _send_path(self, tab):
        if self._keys:
            frames = through(self._keys, round(FPS * _value(self._seconds)))
            text = json.dumps({"frames": [frame_keys(camera) for camera in frames]})
            tab.client.send_file_download("path.json", text.encode(), save_immediately=True)

    # ---- what the thread that has the device calls

    def take(self, run: Run) -> None:
        """Show another checkpoint of the run, to which no Gaussians are fitted yet."""
        self.run, self._splat = run, None
        for tab in list(self._tabs.values()):
            splat, tab.splat = tab.splat, None
            if splat:
                splat.remove()
        self.renew()

    def renew(self) -> None:
        """Redraw all tabs at rest, as the model has changed."""
        for tab in list(self._tabs.values()):
            tab.drawn = 0.0

    def set_rows(self, rows: Sequence[dict[str, Any]]) -> None:
        """Draw the curve of a log's rows, thinned out to about MOST_ROWS."""
        logged = [[row[key] for key in LOGGED] for row in rows if all(key in row for key in LOGGED)]
        thinned = logged[:: 1 + len(logged) // MOST_ROWS]
        self._curve.data = tuple(np.array(thinned, np.float64).reshape(-1, len(LOGGED)).T.copy())
        self._curve.visible = bool(logged)

    def draw_next(self) -> bool:
        """Draw for the tab that has waited longest; return whether any was waiting."""
        self.woken.clear()
        if self._wanted:
            self._send_image(self._wanted.pop(0))
            return True
        for tab in sorted(self._tabs.values(), key=lambda tab: max(tab.drafted, tab.drawn)):
            now = time.monotonic()
            is_moving = now - tab.moved < STILL
            has_drafts = self._show.value not in OWN_CAMERA and not self._by_browser(tab)
            if is_moving and tab.drafted < tab.moved and has_drafts:
                tab.drafted = now
            elif not is_moving and tab.drawn < tab.moved:
                tab.drawn = now
            else:
                continue
            self._send(tab, is_moving)
            return True
        return False

    def tell(self, line: str) -> None:
        """Show the state of the run on the page, with a line below it."""
        step, steps = self.run.header["step"], self.run.config.train.iterations
        points = self.run.model.cloud.count
        self._status.content = f"step {step} of {steps}, {points} points\n\n{plain(line)}"

    def _camera(self, tab):
        """Camera of a rendering that fills a tab, in its pixels, or fewer if these are too many."""
        width, height = tab.camera.width, tab.camera.height
        scale = min(1.0, (self._most_pixels / (width * height)) ** 0.5)
        return tab.camera.resized(*(max(MIN_SIDE, round(scale * side)) for side in (width, height)))

    def _gaussians(self):
        """Arguments of viser's add_gaussian_splats, with mean colours; None if none are fitted."""
        if (gaussians := kept_gaussians(self.run)) is None:
            return None
        table = gaussians.table
        turn = Rotation.from_quat(np.roll(table["turn"], -1, axis=1)).as_matrix()
        axes = turn * table["deviations"][:, None] / self._space.radius
        return {
            "centers": self._space.page(table["position"] + gaussians.origin).astype(np.float32),
            "covariances": (axes @ axes.transpose(0, 2, 1)).astype(np.float32),
            "rgbs": (0.5 + CONSTANT * table["harmonics"][:, 0]).clip(0, 1),
            "opacities": table["opacity"][:, None],
        }

    def _image(self, camera, on_part=lambda: None):
        """draw() with the page's switches; None if it refuses, which the page then shows."""
        stop, share, exposure = map(_value, (self._stop, self._share, self._exposure))
        options = {"early_stop": stop, "share": share / 100, "exposure": exposure}
        try:
            return draw(self.run, self._views, camera, self._show.value, on_part=on_part, **options)
        except UserError as error:
            self.tell(str(error))
            return None

    def _send(self, tab, is_draft):
        """Draw what a tab shows behind its frustums; unless a draft, stop if its camera moves."""
        start, moved, camera = time.perf_counter(), tab.moved, self._camera(tab)
        if is_draft:
            most = min(camera.width, camera.height) // MIN_SIDE
            camera = camera.downscaled(max(1, min(DRAFT, most)))

        def on_part():
            if tab.moved != moved and not is_draft:
                raise _MovedError

        try:
            drawn = self._image(camera, on_part)
        except _MovedError:
            return
        if drawn:
            image, line = drawn
            if self._show.value in OWN_CAMERA:
                image = framed(image, tab.camera.width / tab.camera.height)
            tab.client.scene.set_background_image(image, "jpeg", jpeg_quality=90)
            if tab.splat:
                tab.splat.visible = False
            if not self._is_drawn:
                self._is_drawn = True
                self._server.scene.remove_by_name(WAITING)
            took = time.perf_counter() - start
            if is_draft:
                self._took = took
            else:
                took = f"{1e3 * took:.0f} ms on {self.run.dev.name}"
                self.tell(f"{line}\n\n{image.shape[1]}x{image.shape[0]}, {took}")

    def _send_image(self, tab):
        """Draw what a tab shows into a file for its user to save."""
        if drawn := self._image(self._camera(tab)):
            file = io.BytesIO()
            Image.fromarray(drawn[0]).save(file, "PNG")
            run = self.run.folder.name
            name = f"{run}_step_{self.run.header['step']}_{self._show.value}.png"
            tab.client.send_file_download(name, file.getvalue(), save_immediately=True)


def announce(server: Any, text: str) -> None:
    """Show in the middle of the page what it waits for, until a ModelPage shows a rendering."""
    server.scene.add_label(WAITING, text)


def framed(image: np.ndarray, aspect: float) -> np.ndarray:
    """The (H, W, 3) uint8 image, padded with DARK to an aspect of width over height."""
    height, width = image.shape[:2]
    across, down = max(round(aspect * height) - width, 0), max(round(width / aspect) - height, 0)
    whole = np.full((height + down, width + across, 3), 255 * DARK, np.uint8)
    whole[down // 2 :, across // 2 :][:height, :width] = image
    return whole


def _value(slider):
    """A slider's value, clipped to its bounds whatever a tab has sent."""
    return float(np.clip(np.nan_to_num(slider.value), slider.min, slider.max))
