"""Models of lens distortion, and the removal of distortion from images."""

from dataclasses import astuple, dataclass
from threading import Lock

import numpy as np

from pp_cl.engine.camera import Camera
from pp_cl.engine.device.device import Device

PROBED = 65  # places along each axis at which a lens is tested for folds
BAND_BYTES = 2**23  # bytes of the spline's coefficients on the device at a time
ON_DEVICE = Lock()  # a kernel keeps the arguments of one launch, and threads read images
MARGIN = 8  # coefficients beyond the image's left and right border, as in cl/scene/lens.cl
# extra rows around those that are read, over which the recursion forgets its start (to 3e-7)
RUN_UP = 12
ROWS_PROBED = 9  # rows of a band that are traced to find the rows of the image that it shows


@dataclass(frozen=True)
class LensDistortion:
    """Coefficients of OpenCV's models: the perspective one, or the fisheye one with k1 to k4."""

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    fisheye: bool = False

    def __bool__(self) -> bool:
        """Whether there is any distortion."""
        return any(astuple(self))

    def apply(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where the lens puts the points (x / z, y / z) of the camera's axes, float64 arrays."""
        if self.fisheye:
            r = np.maximum(np.hypot(x, y), 1e-30)
            t = np.arctan(r)
            t2 = t * t
            polynomial = 1 + t2 * (self.k1 + t2 * (self.k2 + t2 * (self.k3 + t2 * self.k4)))
            return x * t / r * polynomial, y * t / r * polynomial
        xx, yy, xy = x * x, y * y, x * y
        r2 = xx + yy
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        radial = radial / (1 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6)))
        return (
            x * radial + 2 * self.p1 * xy + self.p2 * (r2 + 2 * xx),
            y * radial + self.p1 * (r2 + 2 * yy) + 2 * self.p2 * xy,
        )

    def folds(self, camera: Camera) -> bool:
        """Whether two directions meet in one pixel of the camera's image."""
        x = (np.linspace(0, camera.width, PROBED) - camera.cx) / camera.fx
        y = (np.linspace(0, camera.height, PROBED) - camera.cy) / camera.fy
        x, y = self.apply(*np.meshgrid(x, y))
        along_x, along_y = (
            np.stack([np.diff(a, axis=1)[1:], np.diff(a, axis=0)[:, 1:]]) for a in (x, y)
        )
        # NaN counts as a fold
        return not (along_x[0] * along_y[1] - along_x[1] * along_y[0] > 0).all()


def undistort(
    dev: Device, image: np.ndarray, camera: Camera, lens: LensDistortion, factor: int = 1
) -> np.ndarray:
    """(H // factor, W // factor, 4) uint8 straight RGBA: the image (H, W, 4) as the camera would
    have taken it without distortion. Pixels are means of factor x factor samples of a cubic spline
    through the premultiplied colours; beyond the image's border its edge is repeated. Threads wait
    for each other.
    """
    with ON_DEVICE:
        return _undistorted(dev, image, camera, lens, factor)


def _undistorted(dev, image, camera, lens, factor):
    width, height = camera.width // factor, camera.height // factor
    program, columns = dev.program("scene/lens"), camera.width + 2 * MARGIN
    packed = [camera.fx, camera.fy, camera.cx, camera.cy, *astuple(lens)]
    numbers, undistorted = dev.upload(packed, np.float32), np.empty((height, width, 4), np.uint8)
    most = max(1, BAND_BYTES // (16 * columns * factor))
    for top in range(0, height, most):
        bottom = min(top + most, height)
        first, last = _source_rows(camera, lens, factor * top, factor * bottom)
        shape = last - first, columns, 4
        there = image[max(first, 0) : min(last, camera.height)]
        coefficients = dev.empty(shape)
        program.launch(
            "lens_spline_rows",
            (shape[0],),
            width=camera.width,
            rows=shape[0],
            first=min(first, 0),
            image_rows=len(there),
            image=dev.upload(there),
            coefficients=coefficients,
        )
        program.launch(
            "lens_spline_columns",
            (columns,),
            columns=columns,
            rows=shape[0],
            coefficients=coefficients,
        )
        band = dev.empty((bottom - top, width, 4), np.uint8)
        program.launch(
            "lens_undistort",
            (width, bottom - top),
            width=width,
            height=bottom - top,
            top=top,
            factor=factor,
            columns=columns,
            rows=shape[0],
            first=first,
            lens=numbers,
            coefficients=coefficients,
            image=band,
        )
        undistorted[top:bottom] = dev.download(band)
    return undistorted


def _source_rows(camera, lens, top, bottom):
    """(first, last + 1) source rows for the rows top to bottom, with RUN_UP rows on both sides.
    They may lie outside the image, where its edge is repeated, but no further than needed.
    """
    x = (np.arange(camera.width + 1) - camera.cx) / camera.fx
    y = (np.linspace(top, bottom, ROWS_PROBED) - camera.cy) / camera.fy
    rows = camera.fy * lens.apply(*np.meshgrid(x, y))[1] + camera.cy
    beyond = MARGIN + RUN_UP
    first = int(np.clip(rows.min() - 3, -MARGIN, camera.height - 1)) - RUN_UP
    last = int(np.clip(rows.max() + 4, 1, camera.height + MARGIN)) + RUN_UP
    return max(first, -beyond), min(last, camera.height + beyond)
