"""The pinhole camera, and how it is packed for the kernels (cl/camera.h)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike


def divided(factor: float) -> tuple[int, float]:
    """(k, ratio): images that are reduced `factor` times are resampled by the ratio, from 1 to 2,
    and then reduced k times, the largest whole number up to the factor.
    """
    whole = math.floor(factor)
    return whole, factor / whole


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with OpenCV axes: x right, y down, z forward.

    pose: (3, 4) float64 camera-to-world, orthonormal rotation. fx, fy, cx, cy: pixels; the centre
    of pixel (x, y) is (x + 0.5, y + 0.5). samples: only for Gaussians; each pixel is the mean of
    samples x samples pixels of a viewer's rendering. The depth range is the model's, not the
    camera's.
    """

    pose: np.ndarray
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    samples: float = 1.0

    @classmethod
    def look_at(
        cls,
        eye: ArrayLike,
        target: ArrayLike,
        up: ArrayLike = (0.0, 0.0, 1.0),
        *,
        fx: float,
        width: int,
        height: int,
        fy: float | None = None,
    ) -> "Camera":
        """A camera at `eye` whose image shows `target` in its centre, the principal point.

        up: world direction that points up in the image. fy: equals fx if not given.
        """
        pose = look_at(eye, target, up)
        return cls(pose, fx, fx if fy is None else fy, width / 2, height / 2, width, height)

    @property
    def eye(self) -> np.ndarray:
        """(3,) position in world coordinates."""
        return self.pose[:, 3]

    def moved(self, by: ArrayLike) -> "Camera":
        """The camera with its eye moved by (3,) world units."""
        return replace(self, pose=np.column_stack([self.pose[:, :3], np.add(self.eye, by)]))

    def project(self, positions: ArrayLike) -> np.ndarray:
        """Project world positions (..., 3) to (3, ...): x and y in pixels, depth along the axis."""
        x, y, z = np.moveaxis((positions - self.eye) @ self.pose[:, :3], -1, 0)
        return np.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy, z])

    def pixels(self, positions: ArrayLike) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(column, row, is_shown), (N,) each: the pixels that show (N, 3) world positions, and
        whether the image shows them; where it does not, column and row are 0.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y, depth = self.project(positions)
        is_shown = (depth > 0) & (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height)
        column, row = (np.where(is_shown, place, 0).astype(int) for place in (x, y))
        return column, row, is_shown

    def rays(self) -> np.ndarray:
        """(H, W, 3) vectors of depth 1 from the eye through the pixels' centres, in world axes."""
        y, x = np.mgrid[: self.height, : self.width] + 0.5
        axes = (x - self.cx) / self.fx, (y - self.cy) / self.fy, np.ones_like(x)
        return np.stack(axes, -1) @ self.pose[:, :3].T

    def packed(
        self, depth_range: Sequence[float], centre: ArrayLike = (0.0, 0.0, 0.0)
    ) -> np.ndarray:
        """(21,) float32, the layout of cl/camera.h.

        depth_range: (near, far), Euclidean distances from the eye, world units. centre: world
        position that becomes the device's origin; float32 needs it close to the scene.
        """
        return np.concatenate(
            [
                self.pose[:, :3].T.ravel(),
                self.eye - np.asarray(centre),
                [self.fx, self.fy, self.cx, self.cy, *depth_range],
                [self.width, self.height, self.samples],
            ]
        ).astype(np.float32)

    def crop(self, x0: int, y0: int, width: int, height: int) -> "Camera":
        """The camera of columns [x0, x0+width) and rows [y0, y0+height) of this camera's image;
        they may reach outside it.
        """
        return replace(self, cx=self.cx - x0, cy=self.cy - y0, width=width, height=height)

    def shifted(self, dx: float, dy: float) -> "Camera":
        """The camera whose pixels lie (dx, dy) pixels further right and down."""
        return replace(self, cx=self.cx - dx, cy=self.cy - dy)

    def downscaled(self, factor: float) -> "Camera":
        """The camera of the image whose pixels are means of factor x factor pixels; columns and
        rows that fill no block are cut off. Another factor than a whole number: of the image that
        is resampled first, as divided() says.
        """
        factor, ratio = divided(factor)
        if ratio > 1:
            size = int(self.width / ratio), int(self.height / ratio)
            return self.stretched(*size).downscaled(factor)
        return replace(
            self,
            fx=self.fx / factor,
            fy=self.fy / factor,
            cx=self.cx / factor,
            cy=self.cy / factor,
            width=self.width // factor,
            height=self.height // factor,
        )

    def enlarged(self, factor: int) -> "Camera":
        """The camera of an image with factor x factor pixels for each pixel of this camera's."""
        return replace(
            self,
            fx=self.fx * factor,
            fy=self.fy * factor,
            cx=self.cx * factor,
            cy=self.cy * factor,
            width=self.width * factor,
            height=self.height * factor,
        )

    def resized(self, width: int, height: int) -> "Camera":
        """The camera of an image of width x height pixels with the same angle across its width."""
        scale = width / self.width
        cx = scale * self.cx
        cy = scale * (self.cy - self.height / 2) + height / 2
        fx, fy = scale * self.fx, scale * self.fy
        return replace(self, fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)

    def stretched(self, width: int, height: int) -> "Camera":
        """The camera of the same image resampled to width x height pixels."""
        across, down = width / self.width, height / self.height
        return replace(
            self,
            fx=across * self.fx,
            fy=down * self.fy,
            cx=across * self.cx,
            cy=down * self.cy,
            width=width,
            height=height,
        )

    def with_angle(self, radians: float) -> "Camera":
        """The camera with this angle of view across the width of its image."""
        scale = self.width / 2 / math.tan(radians / 2) / self.fx
        return replace(self, fx=scale * self.fx, fy=scale * self.fy)

    def padded(self, multiple: int, margin: int = 0) -> tuple["Camera", int, int]:
        """(camera, left, top): the camera of an image enlarged by `margin` pixels on each side, and
        further until `multiple` divides width and height. This camera's image starts at its column
        `left` and row `top`.
        """
        extra_w, extra_h = (
            2 * margin + -(side + 2 * margin) % multiple for side in (self.width, self.height)
        )
        left, top = extra_w // 2, extra_h // 2
        return self.crop(-left, -top, self.width + extra_w, self.height + extra_h), left, top


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> np.ndarray:
    """(3, 4) float64 camera-to-world pose of a camera at `eye` that looks at `target`.

    up: world direction, not parallel to the line of sight, that points up in the image.
    """
    forward = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    right = np.cross(forward, np.asarray(up))
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(forward, right), forward, eye])
