"""The page of a scene: its cameras with their images, its points, its box and the dropped views.
The user's changes to box and views are written to the scene's folder at once.
"""

import threading
from pathlib import Path
from typing import Any

import numpy as np

from pp_cl import open_device
from pp_cl.config import configure, preset, scene_config
from pp_cl.errors import UserError
from pp_cl.files import read_rgba
from pp_cl.scene import (
    EDITS,
    agreeing,
    build_grid,
    looked_at,
    open_scene,
    read_edits,
    scene_box,
    scene_frames,
    scene_splits,
    sparse_points,
    up_of,
    write_edits,
)
from pp_studio.view.server import plain, switches
from pp_studio.view.space import CHOSEN, VIEW, Space, thumbnail

SHOWN_POINTS = 20_000  # most points that a browser draws while it turns
WIDE = 0.3  # half the side of a suggested box, in distances of the cameras
GREY = 150  # grey level of points without colour
DROPPED, SUGGESTED = (216, 72, 72), (150, 150, 150)  # colours of a dropped view and suggested box
UNREADABLE = np.zeros((1, 1, 3), np.uint8)


class ScenePage:
    """Box and dropped views are kept only in the folder's file: each change reads it, writes it,
    and shows the new content. device: as in `pp-cl devices`. Raises UserError as scene_frames does.
    """

    def __init__(self, server: Any, folder: Path, device: str | None = None) -> None:
        self._server, self._folder, self._device = server, folder, device
        self._lock = threading.Lock()
        self.splits = {
            split: scene_frames(folder, split, edited=False)
            for split in sorted(scene_splits(folder), key=lambda split: split != "train")
        }
        # a view in two splits is one view: the page's list takes each name only once
        self._cameras = {view.name: view.camera for views in self.splits.values() for view in views}
        cameras = list(self._cameras.values())
        self._points, colours = sparse_points(folder)
        box, _ = self._box()
        self._space = Space(box.mean(axis=0), float(np.linalg.norm(box[1] - box[0]) / 2))
        up, eyes = up_of(cameras), self._space.page([camera.eye for camera in cameras])
        distances = np.linalg.norm(eyes, axis=1)
        server.scene.set_up_direction(up)
        # above the first camera, where all cameras are in sight
        first = eyes[0] / distances[0]
        server.initial_camera.position = distances.max() * (1.2 * first + 0.6 * up)
        server.initial_camera.look_at = np.zeros(3)
        self._add_points(self._points, colours)
        self._ends = [
            server.scene.add_transform_controls(
                f"/corner {side}", scale=0.3, disable_rotations=True, depth_test=False
            )
            for side in (0, 1)
        ]
        for end in self._ends:
            end.on_update(self._dragged)
        self._status = server.gui.add_markdown("")
        with switches(server):
            self._add_switches(server.gui, list(self._cameras))
        self._frustums = {}
        for name, camera in self._cameras.items():
            frustum = self._space.add_frustum(server, f"/views/{name}", camera)
            frustum.on_click(lambda _, name=name: setattr(self._view, "value", name))
            self._frustums[name] = frustum
        self._choose()

    def _add_points(self, points, colours):
        if len(points):
            step = 1 + len(points) // SHOWN_POINTS
            points, size = self._space.page(points[::step]), {"point_size": 0.008}
            self._server.scene.add_point_cloud(
                "/points", points, colours[::step], precision="float32", **size
            )

    def _add_switches(self, gui, names):
        with gui.add_folder("Box"):
            step = 1e-3 * self._space.radius
            self._corners = [gui.add_vector3(n, (0.0,) * 3, step=step) for n in ("From", "To")]
            gui.add_button("Set").on_click(
                lambda _: self._change(box=[corner.value for corner in self._corners])
            )
            self._remove = gui.add_button("Remove", hint="leave the box to the images")
            self._remove.on_click(lambda _: self._change(box=None))
        with gui.add_folder("View"):
            self._view = gui.add_dropdown("Name", names)
            self._view.on_update(self._choose)
            self._drop = gui.add_button("Drop", hint="leave this view out, or take it back")
            self._drop.on_click(lambda _: self._change(toggled=self._view.value))
            gui.add_button("Keep all").on_click(lambda _: self._change(dropped=frozenset()))
            self._image = gui.add_image(UNREADABLE)

    def _box(self):
        """((2, 3) box of the user or the format, or else a suggestion; whether it is given)."""
        box = scene_box(configure(preset("tiny"), str(self._folder)))
        if box is not None:
            return box, True
        # suggest the box of sparse points near what the cameras look at, else a cube around that
        cameras = list(self._cameras.values())
        middle = looked_at(cameras)
        reach = WIDE * np.median([np.linalg.norm(c.eye - middle) for c in cameras])
        near = self._points[np.linalg.norm(self._points - middle, axis=1) < 2 * reach]
        box = np.percentile(near, (2, 98), axis=0) if len(near) else np.zeros((2, 3))
        is_wide = (box[1] > box[0]).all()
        return box if is_wide else np.stack([middle - reach, middle + reach]), False

    # ---- what viser's threads call

    def _change(self, toggled=None, **changed):
        """Write the user's changes, if possible. toggled: a view to drop, or to take back."""
        line = f"written to {EDITS}"
        with self._lock:
            try:
                edits = read_edits(self._folder)._replace(**changed)
                if toggled is not None:
                    edits = edits._replace(dropped=edits.dropped ^ {toggled})
                for split, views in self.splits.items():
                    if all(view.name in edits.dropped for view in views):
                        raise UserError(f"no view of split {split} would be left; keep one")
                write_edits(self._folder, edits)
            except UserError as error:
                line = str(error)
            self._tell(line)

    def _dragged(self, event):
        if event.phase == "end":
            self._change(box=self._space.world([end.position for end in self._ends]))

    def _choose(self, _event=None):
        with self._lock:
            self._image.image = self._read(self._view.value)
            self._tell("")

    def _tell(self, line):
        """Show the content of the folder's file, and a line."""
        try:
            dropped, (box, is_given) = read_edits(self._folder).dropped, self._box()
        except UserError as error:
            self._status.content = plain(str(error))
            return
        low, high = self._space.page(box)
        colour, options = CHOSEN if is_given else SUGGESTED, {"opacity": 0.15, "side": "double"}
        middle = (low + high) / 2
        self._server.scene.add_box("/box", colour, high - low, position=middle, **options)
        for i, at in enumerate((low, high)):
            self._ends[i].position, self._corners[i].value = at, tuple(box[i].tolist())
        chosen = self._view.value
        for name, frustum in self._frustums.items():
            usual = CHOSEN if name == chosen else VIEW
            frustum.color = DROPPED if name in dropped else usual
        self._remove.disabled = not is_given
        self._drop.label = "Take back" if chosen in dropped else "Drop"
        count, views = len(self._frustums.keys() - dropped), len(self._frustums)
        state = "given" if is_given else "suggested"
        self._status.content = f"{count} of {views} views, box {state}\n\n{plain(line)}"

    # ---- the slow work

    def serve(self) -> None:
        """Fill the page, then serve it forever."""
        self.fill()
        self._server.sleep_forever()

    def fill(self) -> None:
        """Put the images into the frustums; if the scene has no points, show those of a coarse
        visual hull of its masks.
        """
        for name, frustum in self._frustums.items():
            frustum.image = self._read(name)
        if not len(self._points):
            try:
                points = hull_points(self._device, str(self._folder))
            except UserError as error:
                self._status.content += f"\n\n{plain(str(error))}"
            else:
                self._add_points(points, np.full((len(points), 3), GREY, np.uint8))

    def _read(self, name):
        """(h, w, 3) uint8 image of a view, reduced, upright as its camera is."""
        camera = self._cameras[name]
        try:
            return thumbnail(read_rgba(self._folder / name, (camera.width, camera.height)))
        except UserError:
            return UNREADABLE


def hull_points(device: str | None, folder: str) -> np.ndarray:
    """(N, 3) world positions of a coarse visual hull. Raises UserError if masks leave none."""
    dev, config = open_device(device), scene_config(folder, "tiny")
    views, box = open_scene(dev, config, ("train",)).splits["train"], scene_box(config)
    views, _, forgiven = agreeing(dev, views, box)
    hull = build_grid(dev, views, SHOWN_POINTS, box, forgiven)
    return hull.grid.positions(hull.ids)
