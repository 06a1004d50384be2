"""The part of a photograph around the projected box of the object, in which it is cut out."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pp_cl import Camera
from pp_cl.errors import UserError
from pp_cl.scene import ImageFile
from pp_studio.capture.box import corners_of
from pp_studio.capture.packages import needed

cv2 = needed("cv2")

CUT_SIDE = 400  # pixels of what is cut: the projected box and what is around it
AROUND = 0.2  # of the projected box, on each side: shows what the background looks like


@dataclass(eq=False)
class Window:
    """The part of a photograph around the projected box, reduced for cutting.

    image: (H, W, 3) uint8. camera: of it. place: (x0, y0, x1, y1) in the photograph. mask: (H, W)
    bool, None until it is known.
    """

    name: str
    image: np.ndarray
    camera: Camera
    place: tuple[int, int, int, int]
    mask: Any = None

    def pixels(self, positions: np.ndarray) -> np.ndarray:
        """(N, 2) x and y of world positions (N, 3); NaN behind the camera."""
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y, depth = self.camera.project(positions)
        return np.where(depth > 0, [x, y], np.nan).T

    def pixels_in(self, other: "Window") -> np.ndarray:
        """(H, W, 2) float32 x and y of this one's pixels in another window that lies at the same
        places of its photograph, 0 in the middle of the first pixel.
        """
        at = []
        for axis in (0, 1):
            (begin, end), (first, last) = self.place[axis::2], other.place[axis::2]
            size, others = self.image.shape[1 - axis], other.image.shape[1 - axis]
            places = begin + (np.arange(size) + 0.5) * (end - begin) / size
            at.append((places - first) * others / (last - first) - 0.5)
        return np.stack(np.meshgrid(*at), axis=-1).astype(np.float32)

    def reduced(self, image: np.ndarray) -> np.ndarray:
        """The part of an image of the photograph's size, (H, W) or (H, W, C), reduced to this."""
        x0, y0, x1, y1 = self.place
        size = self.camera.width, self.camera.height
        return cv2.resize(image[y0:y1, x0:x1], size, interpolation=cv2.INTER_AREA)

    def inside(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """((M,) indices of the positions that lie in the image, their rows, their columns)."""
        column, row, is_shown = self.camera.pixels(positions)
        return np.flatnonzero(is_shown), row[is_shown], column[is_shown]

    def marked(self, positions: np.ndarray) -> np.ndarray:
        """(H, W) bool: the pixels that show world positions (N, 3)."""
        _, rows, columns = self.inside(positions)
        shown = np.zeros(self.image.shape[:2], bool)
        shown[rows, columns] = True
        return shown


def place_of(image_file: ImageFile, box: np.ndarray) -> tuple[int, int, int, int] | None:
    """(x0, y0, x1, y1) around the projected box (2, 3) in a photograph; None where it is
    outside.
    """
    camera = image_file.camera
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y, depth = camera.project(corners_of(box))
    if depth.min() <= 0:  # the box is around the camera
        x, y = np.array([0, camera.width]), np.array([0, camera.height])
    if x.max() < 1 or y.max() < 1 or x.min() > camera.width - 1 or y.min() > camera.height - 1:
        return None
    (x0, x1), (y0, y1) = _grown(x, camera.width), _grown(y, camera.height)
    return x0, y0, x1, y1


def window(image: np.ndarray, image_file: ImageFile, box: np.ndarray) -> Window:
    """The Window of a photograph, (H, W, 3) uint8. Raises UserError where it does not show the box
    (2, 3).
    """
    place = place_of(image_file, box)
    if place is None:
        raise UserError(f"{image_file.name}: the object's box is outside; give another with --box")
    x0, y0, x1, y1 = place
    scale = min(1, CUT_SIDE / max(x1 - x0, y1 - y0))
    width, height = (max(2, round(scale * n)) for n in (x1 - x0, y1 - y0))
    sx, sy = width / (x1 - x0), height / (y1 - y0)
    camera = image_file.camera.crop(x0, y0, width, height)
    camera = replace(
        camera, fx=sx * camera.fx, fy=sy * camera.fy, cx=sx * camera.cx, cy=sy * camera.cy
    )
    found = Window(image_file.name, image, camera, place)
    return replace(found, image=found.reduced(image))


def _grown(places, size):
    """(first, last + 1) pixel of the places, grown by AROUND, within an image's side."""
    margin = AROUND * np.ptp(places)
    return max(0, int(places.min() - margin)), min(size, int(places.max() + margin) + 1)


def dilated(marked: np.ndarray, radius: int) -> np.ndarray:
    """(H, W) bool: the marked pixels and those no further than a radius from one."""
    return cv2.dilate(marked.astype(np.uint8), disc(radius)) > 0


def disc(radius: int) -> np.ndarray:
    """A filled circle for OpenCV's morphology."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
