"""Images that a training has read, freed of distortion and reduced, in the folder of its run: it
resumes without decoding large photographs again.
"""

import hashlib
import io
import os
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from pp_cl.engine.views import View
from pp_cl.errors import UserError
from pp_cl.files.atomic import atomic_file, remove_ours
from pp_cl.files.image import read_rgba
from pp_cl.scene.image_file import Photograph

DIGITS = 32  # of a file's name, hexadecimal
DIGEST = "pp_cl digest"  # text in a file: View.digest


class KeptViews:
    """The kept images of one training. folder: where they lie, as PNG files that are named after
    all that decides their pixels; it may be removed at any time.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._files: dict[str, Path] = {}  # by the name of the photograph
        self._new: list[View] = []

    def find(
        self, photograph: Photograph, files: Sequence[Path | None], how: Any
    ) -> tuple[np.ndarray, str] | None:
        """(image, digest) of a photograph's View; None where it is not kept.

        files: the image and its mask, whose sizes and times tell whether they were changed. how:
        they are read, anything with a repr().
        """
        facts = [(f.resolve(), f.stat().st_size, f.stat().st_mtime_ns) for f in files if f]
        one = photograph.camera
        lens = one.fx, one.fy, one.cx, one.cy, one.width, one.height, photograph.distortion
        key = hashlib.sha256(repr((facts, lens, how)).encode()).hexdigest()[:DIGITS]
        file = self._files[photograph.name] = self.folder / f"{key}.png"
        try:
            with Image.open(file, formats=("PNG",)) as image:
                digest = image.text[DIGEST]  # type: ignore[attr-defined]
            return read_rgba(file), digest
        except Exception:  # whatever is wrong with it, the photograph is there
            return None

    def take(self, view: View) -> None:
        """Remember the image of a photograph that was not kept, for write()."""
        self._new.append(view)

    def write(self) -> None:
        """Write the images that were not kept yet; warns where that fails, as nothing depends on
        them.
        """
        try:
            if self._new:
                self.folder.mkdir(exist_ok=True)
            with ThreadPoolExecutor(os.cpu_count()) as pool:
                list(pool.map(self._write, self._new))
        except (OSError, UserError) as error:
            warnings.warn(f"{error}; a resume reads the photographs again", stacklevel=2)
        self._new = []

    def _write(self, view):
        encoded, text = io.BytesIO(), PngInfo()
        text.add_text(DIGEST, view.digest)
        Image.fromarray(view.image).save(encoded, "PNG", pnginfo=text, compress_level=1)
        with atomic_file(self._files[view.name]) as file:
            file.write(encoded.getbuffer())

    def remove(self) -> None:
        """Remove the images of this training, as far as it has written them, and their folder where
        nothing else is in it.
        """
        with suppress(OSError):
            remove_ours(self._files.values())
