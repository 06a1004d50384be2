"""Frames of a run along a path of cameras, which a later call goes on with, and films of them."""

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from filelock import FileLock, Timeout

from pp_cl.errors import UserError
from pp_cl.files.atomic import check_file, check_target, remove_leftovers, write_json
from pp_cl.files.exr import write_exr
from pp_cl.files.image import read_rgba, write_png
from pp_cl.files.picture import WHITE
from pp_cl.files.untrusted import read_regular
from pp_cl.files.video import write_video
from pp_cl.run import Run
from pp_cl.scene.camera import Camera

MOST_IDENTITY = 1000  # bytes of it
IDENTITY = "frames.json"  # in the folder of the frames: what they show
LOCK = ".lock"


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

    replace: frames that are there and show something else make room.
    """

    def __init__(
        self,
        run: Run,
        cameras: Sequence[Camera],
        folder: Path,
        style: Style,
        *,
        replace: bool = False,
    ):
        self.run, self.cameras, self.folder, self.style = run, cameras, folder, style
        self._replace = replace
        self.paths = [folder / f"{i:05d}.{style.suffix}" for i in range(len(cameras))]
        self._identity = {"frames": self._digest(), "count": len(cameras)}
        # Python stands for bytes that are no UTF-8 by these
        if style.suffix == "exr" and any("\udc80" <= c <= "\udcff" for c in str(folder)):
            raise UserError(
                f"{folder}: OpenEXR writes no file whose name is no UTF-8; choose another --out"
            )

    def _digest(self):
        """Of everything that the frames depend on."""
        checkpoint = self.run.folder.checkpoint.stat()
        digest = hashlib.sha256(repr((self.style, self.run.header["step"])).encode())
        digest.update(f"{checkpoint.st_size} {checkpoint.st_mtime_ns}".encode())
        for camera in self.cameras:
            digest.update(self.run.model.packed(camera).tobytes())
        return digest.hexdigest()

    def _check_folder(self):
        if all(p.name.startswith(".") for p in self.folder.iterdir()):
            return
        file = self.folder / IDENTITY
        try:
            there = json.loads(read_regular(file, MOST_IDENTITY))
        except (OSError, ValueError, RecursionError):
            raise UserError(
                f"{self.folder}: holds files that are no frames; choose another --out"
            ) from None
        if there != self._identity and not self._replace:
            raise UserError(
                f"{self.folder}: holds frames of another model or path; choose another --out, or"
                " delete it"
            )
        if there != self._identity:
            for frame in self.folder.glob(f"*.{self.style.suffix}"):
                frame.unlink()

    def render(self, on_frame: Callable[[float | None], None]) -> None:
        """Render the frames that are not there yet into the folder, which this process owns;
        on_frame is called after each one with its seconds, None for one that was there. Raises
        UserError where it holds other files, or other frames and they are not replaced.
        """
        self._check_folder()
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

    def _images(self) -> Iterator[np.ndarray]:
        """uint8 images, (H, W, 3) or with straight alpha (H, W, 4), of PNG frames."""
        for path in self.paths:
            image = read_rgba(path)
            yield image if self.style.background is None else image[..., :3]

    def write_film(self, path: Path, fps: float) -> None:
        """Write all frames as a film; raises UserError as write_video does."""
        write_video(path, self._images(), fps)


@contextmanager
def owned_folder(folder: Path, out: Path) -> Iterator[None]:
    """While the block runs, no other process renders into the folder, which is made where it is
    missing, and removed where it is empty in the end. Raises UserError naming `out` where another
    does, or where it cannot be made.
    """
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{folder}: is not a folder; choose another --out")
    check_target(folder / LOCK)
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / LOCK, timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise UserError(
            f"{out}: another process makes it; wait for its end, or choose another --out"
        ) from None
    try:
        yield
    finally:
        # before the release: whoever comes next makes another
        (folder / LOCK).unlink(missing_ok=True)
        lock.release()
        with suppress(OSError):
            folder.rmdir()


@contextmanager
def film_folder(film: Path) -> Iterator[Path]:
    """A hidden folder beside a film, for its frames: removed when the block ends well, else kept
    for the next time. Raises UserError where the film cannot be written, or another process makes
    it.
    """
    check_file(film)
    folder, is_kept = film.with_name(f".{film.name}.frames"), True
    with owned_folder(folder, film):
        try:
            yield folder
            is_kept = False
        finally:
            if not (is_kept and any(folder.glob("*.png"))):
                for file in set(folder.iterdir()) - {folder / LOCK}:
                    with suppress(OSError):
                        file.unlink()
