"""Lens distortion models, and undistorting photographs."""

from dataclasses import astuple, dataclass

import numpy as np

from pp_cl.scene.camera import Camera

CUBIC = 3  # order of interpolation
PROBED = 65  # places along each axis


@dataclass(frozen=True)
class Distortion:
    """Coefficients of OpenCV's models: radial (k1, k2, k3) and tangential (p1, p2) of a perspective
    lens, k1 to k4 of a fisheye.
    """

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    fisheye: bool = False

    def __bool__(self) -> bool:
        """Whether it changes anything."""
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
        return (
            x * radial + 2 * self.p1 * xy + self.p2 * (r2 + 2 * xx),
            y * radial + self.p1 * (r2 + 2 * yy) + 2 * self.p2 * xy,
        )

    def folds(self, camera: Camera) -> bool:
        """Whether the model turns back inside the camera's image, so that two directions meet in
        one pixel: there its polynomials say nothing of the lens.
        """
        x = (np.linspace(0, camera.width, PROBED) - camera.cx) / camera.fx
        y = (np.linspace(0, camera.height, PROBED) - camera.cy) / camera.fy
        x, y = self.apply(*np.meshgrid(x, y))
        along_x, along_y = (
            np.stack([np.diff(a, axis=1)[1:], np.diff(a, axis=0)[:, 1:]]) for a in (x, y)
        )
        # NaN counts as a fold
        return not (along_x[0] * along_y[1] - along_x[1] * along_y[0] > 0).all()

    def source_pixels(self, camera: Camera) -> np.ndarray:
        """(2, H, W) float64: for each pixel of the camera without distortion, row and column of
        the photograph, in pixel indices (a centre is whole), where its content lies.
        """
        x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
        y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
        x, y = self.apply(*np.meshgrid(x, y))
        return np.stack([camera.fy * y + camera.cy, camera.fx * x + camera.cx]) - 0.5


def undistort(image: np.ndarray, camera: Camera, distortion: Distortion) -> np.ndarray:
    """(H, W, 4) uint8 straight RGBA that the camera would have taken without distortion.

    Interpolated on premultiplied colour; beyond the photograph's border its edge goes on.
    """
    from skimage.transform import warp  # takes long to import

    alpha = image[..., 3:].astype(np.float64) / 255
    planes = np.concatenate([image[..., :3] / 255 * alpha, alpha], axis=2)
    source = distortion.source_pixels(camera)
    planes = np.stack(
        [warp(planes[..., i], source, order=CUBIC, mode="edge", clip=True) for i in range(4)],
        axis=2,
    )
    alpha = np.clip(planes[..., 3:], 0, 1)
    colour = np.clip(planes[..., :3] / np.maximum(alpha, 1e-3), 0, 1)
    return (np.concatenate([colour, alpha], axis=2) * 255 + 0.5).astype(np.uint8)
