"""Frames of a run along a path of cameras, which a later call goes on with, and films of them."""

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pp_cl.errors import UserError
from pp_cl.files.atomic import remove_leftovers, write_json
from pp_cl.files.contact_sheet import tiles
from pp_cl.files.exr import write_exr
from pp_cl.files.image import read_rgba, write_png
from pp_cl.files.picture import WHITE
from pp_cl.files.regular import read_regular
from pp_cl.files.video import write_video
from pp_cl.scene.camera import Camera
from pp_cl.trained import Run

MOST_IDENTITY = 1000  # bytes of it
IDENTITY = "frames.json"  # in the folder of the frames: what they show
SHEET_FRAMES, SHEET_COLUMNS, SHEET_SIDE = 12, 4, 240  # a contact sheet's; pixels of a longer side


@dataclass(frozen=True)
class Style:
    """How frames are rendered and written.

    suffix: png or exr. background: sRGB in [0, 1], None: transparent; OpenEXR always is. samples:
    per pixel, a square number. features: in OpenEXR, the network's input too.
    """

    suffix: str = "png"
    background: tuple[float, float, float] | None = WHITE
    samples: int = 1
    features: bool = False


class Frames:
    """The frames of a run along a path, in a folder of their own.

    Raises UserError where the folder holds something else, or frames that show something else.
    """

    def __init__(self, run: Run, cameras: Sequence[Camera], folder: Path, style: Style):
        self.run, self.cameras, self.folder, self.style = run, cameras, folder, style
        self.paths = [folder / f"{i:05d}.{style.suffix}" for i in range(len(cameras))]
        self._identity = {"frames": self._digest(), "count": len(cameras)}
        self._check_folder()

    def _digest(self):
        """Of everything that the frames depend on."""
        checkpoint = self.run.folder.checkpoint.stat()
        digest = hashlib.sha256(repr((self.style, self.run.header["step"])).encode())
        digest.update(f"{checkpoint.st_size} {checkpoint.st_mtime_ns}".encode())
        for camera in self.cameras:
            digest.update(self.run.model.packed(camera).tobytes())
        return digest.hexdigest()

    def _check_folder(self):
        mend = "choose another --out, or delete it"
        if self.folder.exists() and not self.folder.is_dir():
            raise UserError(f"{self.folder}: is not a folder; {mend}")
        if not self.folder.exists() or not any(self.folder.iterdir()):
            return
        file = self.folder / IDENTITY
        try:
            there = json.loads(read_regular(file, MOST_IDENTITY))
        except (OSError, ValueError, RecursionError):
            raise UserError(f"{self.folder}: holds files that are no frames; {mend}") from None
        if there != self._identity:
            raise UserError(f"{self.folder}: holds frames of another model or path; {mend}")

    def render(self, on_frame: Callable[[float | None], None]) -> None:
        """Render the frames that are not there yet; on_frame is called after each one with its
        seconds, None for one that was there.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        remove_leftovers(self.folder)
        write_json(self.folder / IDENTITY, self._identity)
        for camera, path in zip(self.cameras, self.paths, strict=True):
            start = time.perf_counter()
            there = path.exists()
            if not there:
                self._render(camera, path)
            on_frame(None if there else time.perf_counter() - start)

    def _render(self, camera, path):
        style = self.style
        picture = self.run.render(camera, samples=style.samples, features=style.features)
        if style.suffix == "exr":
            write_exr(path, picture.channels())
        else:
            write_png(path, picture.image(style.background))

    def images(self, chosen: Sequence[int] | None = None) -> Iterator[np.ndarray]:
        """uint8 images, (H, W, 3) or with straight alpha (H, W, 4), of the chosen frames, else of
        all.
        """
        transparent = self.style.suffix == "exr" or self.style.background is None
        for i in range(len(self.paths)) if chosen is None else chosen:
            image = read_rgba(self.paths[i])
            yield image if transparent else image[..., :3]

    def write_sheet(self, path: Path) -> None:
        """Write a contact sheet of frames along the whole path."""
        n = len(self.paths)
        chosen = sorted({n * i // SHEET_FRAMES for i in range(SHEET_FRAMES)})
        images = [_reduced(image) for image in self.images(chosen)]
        write_png(path, tiles(images, min(SHEET_COLUMNS, len(images))))

    def write_film(self, path: Path, fps: float) -> None:
        """Write all frames as a film; raises UserError as write_video does."""
        write_video(path, self.images(), fps)


def _reduced(image):
    """The uint8 image with a longer side of at most SHEET_SIDE pixels: every k-th pixel's block."""
    k = -(-max(image.shape[:2]) // SHEET_SIDE)
    height, width = image.shape[0] // k * k, image.shape[1] // k * k
    blocks = image[:height, :width].reshape(height // k, k, width // k, k, -1)
    return np.rint(blocks.mean(axis=(1, 3))).astype(np.uint8)
