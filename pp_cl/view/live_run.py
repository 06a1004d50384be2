"""The run that the viewer shows: renders its last checkpoint and reads its log, again when they
change.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from pp_cl.device.device import Device
from pp_cl.errors import UserError
from pp_cl.files.image import to_8bit
from pp_cl.files.run_folder import RunFolder
from pp_cl.model import Model
from pp_cl.render import Renderer
from pp_cl.run import Run, load_run
from pp_cl.scene.camera import Camera
from pp_cl.scene.camera_path import up_of
from pp_cl.scene.readers.frame import frame_keys
from pp_cl.scene.target import Target
from pp_cl.scene.views import View
from pp_cl.view import shown
from pp_cl.view.messages import LEAST_SIDE, ViewRequest

DRAFT = 4  # times fewer pixels each way while the camera moves
LOGGED = ("step", "loss", "psnr")
OWN_CAMERA = ("error", "photograph")  # are shown from the nearest training view's own camera


class LiveRun:
    """A run folder that may still be trained into; used by one thread at a time.

    waiting: why there is nothing to draw yet, one line, or None. notice: one line about photographs
    that are missing, or None. loads: how often a checkpoint was taken up.
    """

    def __init__(self, dev: Device, folder: Path | str, scene: str | None = None) -> None:
        self.dev = dev
        self.folder = RunFolder(folder)
        self.waiting: Any = f"{folder}: no checkpoint yet; waiting for the first one"
        self.notice: Any = None
        self.loads = 0
        self._scene_path = scene
        self._run: Run | None = None
        self._views: list[View] = []
        self._stamp = self._log_stamp = None
        self._fewer = None  # (share, Renderer) of the points last kept
        self._target = Target(dev)

    def refresh(self) -> bool:
        """Take up the checkpoint if it is another one than last time; whether anything changed. A
        broken one leaves the last model in place, or a line in `waiting`.
        """
        stamp = _stamp(self.folder.checkpoint)
        if stamp in (None, self._stamp):
            return False
        self._stamp = stamp
        try:
            run = load_run(self.dev, self.folder.path, scene=self._scene_path)
        except UserError as error:
            if self._run is None:
                self.waiting = str(error)
            else:
                self.notice = str(error)
            return True
        if not self.loads:
            self._views, self.notice = _training_views(run)
        self._run, self._fewer, self.waiting = run, None, None
        self.loads += 1
        return True

    def new_rows(self) -> list[list[float]] | None:
        """[[step, loss, psnr]] of the log where it has changed since the last call, else None."""
        stamp = _stamp(self.folder.log)
        if stamp in (None, self._log_stamp):
            return None
        self._log_stamp = stamp
        try:
            rows = self.folder.rows()
        except UserError:  # a log that is too large
            return None
        return [[row[key] for key in LOGGED] for row in rows if all(key in row for key in LOGGED)]

    def facts(self) -> dict[str, Any]:
        """What the page shows about the run, JSON-able."""
        facts = {
            "name": self.folder.path.resolve().name,
            "waiting": self.waiting,
            "notice": self.notice,
            "loads": self.loads,
            "device": self.dev.name,
            "platform": self.dev.info["platform"],
        }
        if run := self._run:
            facts |= {
                "step": run.header["step"],
                "iterations": run.config.train.iterations,
                "finished": run.header["finished"],
                "points": run.model.cloud.count,
                "early_stop": run.config.raster.early_stop,
                "photographs": bool(self._views),
            }
        return facts

    def surroundings(self) -> dict[str, Any] | None:
        """What the page turns around and draws beside the picture, JSON-able: the object's centre
        and radius, what is up, the first camera, the training views. None while there is no model.
        """
        if self._run is None:
            return None
        centre, radius = self._run.ball
        cameras, photographs = self._run.cameras("train"), self._run.photographs("train")
        named = zip(photographs, cameras, strict=True)
        return {
            "centre": centre.tolist(),
            "radius": radius,
            "up": up_of(cameras).tolist(),
            "camera": frame_keys(cameras[0]),
            "views": [{"name": one.name, "camera": frame_keys(c)} for one, c in named],
        }

    def draw(self, request: ViewRequest) -> tuple[dict[str, Any], bytes]:
        """(facts, JSON-able; PNG or JPEG file) of the picture that is asked for. Raises UserError
        where there is none to be had.
        """
        run = self._run
        if run is None:
            raise UserError(self.waiting)
        start, index, camera = time.perf_counter(), None, request.camera
        if request.show in OWN_CAMERA:
            if not self._views:
                raise UserError(self.notice)
            index = nearest_view([v.camera for v in self._views], camera, run.ball[0])
            camera = self._views[index].camera
        factor = draft_factor(camera) if request.draft else 1
        camera = camera.downscaled(factor)
        photograph = None if index is None else self._photograph(self._views[index], factor)
        image, scale = self._image(request, camera, photograph)
        if request.exposure:
            image = shown.exposed(image, request.exposure)
        lossless = request.kind == "snapshot"
        data = shown.encoded(image, lossless)
        return {
            "type": request.kind,
            "number": request.number,
            "show": request.show,
            "draft": request.draft,
            "mime": "image/png" if lossless else "image/jpeg",
            "camera": frame_keys(camera),
            "view": index,
            "scale": scale,
            "step": run.header["step"],
            "milliseconds": round(1e3 * (time.perf_counter() - start), 1),
        }, data

    def _image(self, request, camera, photograph):
        """((H, W, 3) uint8, (lowest, highest) of its colour scale or None)."""
        run, show = self._run, request.show
        if show == "photograph":
            return to_8bit(photograph), None
        renderer = self._renderer(request.kept)
        options = {
            "early_stop": request.early_stop,
            "depth_range": run.depth_range(camera),
        }
        if show == "hits":
            hits = hits_per_pixel(renderer, camera, run.gamma, **options)
            most = int(hits.max())
            return shown.colour_scale(hits, 0, most, hits > 0), (0, most)
        picture = renderer.picture(camera, run.gamma, **options)
        run.checked(picture.colour)
        if show == "alpha":
            return shown.grey(picture.alpha), None
        known = picture.alpha >= shown.LEAST_ALPHA
        if show == "depth":
            centre, radius = run.ball
            middle = float((centre - camera.eye) @ camera.pose[:, 2])
            scale = max(middle - radius, 0.0), max(middle + radius, 0.0)
            return shown.colour_scale(picture.depth, *scale, known), scale
        if show == "normals":
            depth = np.where(known, picture.depth, np.inf)
            return shown.normal_colours(shown.normals_from_depth(depth, camera)), None
        if show == "error":
            return shown.error_image(picture.colour, photograph), None
        return to_8bit(picture.colour), None

    def _renderer(self, kept):
        """Renders the share `kept` of the points."""
        run = self._run
        if kept == 1:
            return run.renderer
        if self._fewer is None or self._fewer[0] != kept:
            network = run.renderer.model.net  # of the run's renderer, which has frozen it
            model = most_opaque(run.model, network, kept)
            self._fewer = kept, Renderer(self.dev, model, run.config.raster)
        return self._fewer[1]

    def _photograph(self, view, factor):
        """(H, W, 3) float32 of a view, reduced `factor` times more than the run's."""
        return self._target.whole(view.reduced(view.downscale * factor))


def _training_views(run):
    """(training views, notice): without views, why."""
    try:
        return run.scene("train").splits["train"], None
    except UserError as error:
        return [], f"no photographs: {error}"


def _stamp(path):
    """What differs when a file is replaced or grows; None where there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size, found.st_ino


def nearest_view(cameras: list[Camera], camera: Camera, centre: np.ndarray) -> int:
    """Which of the cameras is nearest to another: by the distance of the eyes, plus the angle
    between the axes times the eye's distance from the object's centre (3,).
    """
    radius = np.linalg.norm(camera.eye - centre)
    apart = [np.linalg.norm(other.eye - camera.eye) for other in cameras]
    turned = [np.arccos(np.clip(c.pose[:, 2] @ camera.pose[:, 2], -1, 1)) for c in cameras]
    return int(np.argmin(np.array(apart) + radius * np.array(turned)))


def draft_factor(camera: Camera) -> int:
    """How many times a draft is smaller each way: DRAFT, or less where sides would get too short
    for the network.
    """
    return max(1, min(DRAFT, min(camera.width, camera.height) // LEAST_SIDE))


def most_opaque(model: Model, network: Any, share: float) -> Model:
    """A copy of a model with that share of its points, in (0, 1], those of the highest opacity, and
    at least one. network: the UNet of the copy.
    """
    opacity = model.cloud.opacity.get()
    count = max(1, round(share * len(opacity)))
    keep = np.sort(np.argsort(-opacity, kind="stable")[:count]).astype(np.uint32)
    cloud = model.cloud.rows(model.dev, model.dev.upload(keep))
    return Model(model.dev, model.grid, model.depth_range, cloud, net=network)


def hits_per_pixel(renderer: Renderer, camera: Camera, gamma: float, **options: Any) -> np.ndarray:
    """(H, W) int64: the hits of each pixel. options: of Renderer.forward()."""
    view = renderer.forward(camera, gamma, until="weights", **options)
    hits = np.diff(view.pairs.pixel_offset.get().astype(np.int64))
    return view.cropped(hits.reshape(view.size))
