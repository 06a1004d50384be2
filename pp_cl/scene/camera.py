"""The pinhole camera of cl/camera.h."""

from dataclasses import dataclass, replace

import numpy as np

CAMERA_FLOATS = 20


@dataclass(frozen=True)
class Camera:
    """A pinhole camera, OpenCV axes (x right, y down, z forward), pixel centres at +0.5.

    pose: (3, 4) float64 camera-to-world, orthonormal rotation. near, far: Euclidean distance from
    the eye, world units.
    """

    pose: np.ndarray
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    near: float = 2.0
    far: float = 6.0

    @property
    def eye(self):
        """(3,) position in world coordinates."""
        return self.pose[:, 3]

    def packed(self):
        """(20,) float32, the layout of cl/camera.h."""
        return np.concatenate(
            [
                self.pose[:, :3].T.ravel(),
                self.eye,
                [self.fx, self.fy, self.cx, self.cy, self.near, self.far, self.width, self.height],
            ]
        ).astype(np.float32)

    def crop(self, x0, y0, width, height):
        """The camera that sees columns [x0, x0+width) and rows [y0, y0+height); may reach outside
        this one.
        """
        return replace(self, cx=self.cx - x0, cy=self.cy - y0, width=width, height=height)

    def shifted(self, dx, dy):
        """The camera whose pixels lie (dx, dy) pixels further right and down: a sub-pixel phase."""
        return replace(self, cx=self.cx - dx, cy=self.cy - dy)

    def downscaled(self, k):
        """The camera of the image reduced k times by averaging k x k blocks; rows and columns left
        over are cut off.
        """
        return replace(
            self,
            fx=self.fx / k,
            fy=self.fy / k,
            cx=self.cx / k,
            cy=self.cy / k,
            width=self.width // k,
            height=self.height // k,
        )

    def padded(self, multiple):
        """(camera, left, top): enlarged so that both sides divide by `multiple`; crop the picture
        at (left, top).
        """
        extra_w, extra_h = -self.width % multiple, -self.height % multiple
        left, top = extra_w // 2, extra_h // 2
        return self.crop(-left, -top, self.width + extra_w, self.height + extra_h), left, top
