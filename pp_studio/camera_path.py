"""Camera paths: around an object (orbit, spiral), made from the cameras of its images, and
through given cameras.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from pp_cl import Camera
from pp_cl.scene import looked_at, up_of

MARGIN = 0.95  # of the image that the object may fill
HIGHEST = math.radians(60)  # elevation of an orbit or spiral; near the poles an image would spin
TURNS = 2  # of a spiral
NEIGHBOURS = 4  # of a camera, in whose directions another lies between()
SAMPLED_POINTS = 20_000


class Surroundings:
    """Where cameras were around an object.

    cameras: those of the images. points: (N, 3), world positions of the object's points.
    """

    def __init__(self, cameras: Sequence[Camera], points: np.ndarray):
        self.up = up_of(cameras)
        self.centre = (points.min(axis=0) + points.max(axis=0)) / 2
        step = max(1, len(points) // SAMPLED_POINTS)
        self._points = points[::step] - self.centre
        offsets = np.array([camera.eye - self.centre for camera in cameras])
        self.distance = float(np.median(np.linalg.norm(offsets, axis=1)))
        heights = offsets @ self.up / np.linalg.norm(offsets, axis=1)
        self.elevations = np.clip(np.arcsin(np.clip(heights, -1, 1)), -HIGHEST, HIGHEST)
        self._ahead = level(offsets[0], self.up)
        self._aside = np.cross(self.up, self._ahead)

    def orbit(self, camera: Camera, frames: int) -> list[Camera]:
        """A circle at the images' median elevation that begins where the first of them was
        taken; the last frame is one step before the first. camera: size and angle of view.
        """
        angles = 2 * math.pi * np.arange(frames) / frames
        return self._around(camera, angles, np.full(frames, np.median(self.elevations)))

    def spiral(self, camera: Camera, frames: int) -> list[Camera]:
        """Two turns from the lowest tenth of the images' elevations to the highest."""
        low, high = np.quantile(self.elevations, [0.1, 0.9])
        angles = TURNS * 2 * math.pi * np.arange(frames) / frames
        return self._around(camera, angles, np.linspace(low, high, frames))

    def _around(self, camera, angles, elevations):
        """Cameras at these angles that look at the centre, from one distance: that of the
        images, or farther where the object would be cut off.
        """
        offsets = [
            math.cos(e) * (math.cos(a) * self._ahead + math.sin(a) * self._aside)
            + math.sin(e) * self.up
            for a, e in zip(angles, elevations, strict=True)
        ]
        size = {"fx": camera.fx, "width": camera.width, "height": camera.height}
        poses = [Camera.look_at(offset, (0, 0, 0), self.up, **size).pose for offset in offsets]
        distance = max(self.distance, *(self._least_distance(camera, pose) for pose in poses))
        centred = replace(camera, cx=camera.width / 2, cy=camera.height / 2)
        return [
            replace(centred, pose=np.column_stack([pose[:, :3], self.centre + distance * offset]))
            for pose, offset in zip(poses, offsets, strict=True)
        ]

    def _least_distance(self, camera, pose):
        """From which all points are in the image of a camera of this direction."""
        x, y, z = (self._points @ pose[:, :3]).T
        across = np.abs(x) * 2 * camera.fx / (MARGIN * camera.width) - z
        down = np.abs(y) * 2 * camera.fy / (MARGIN * camera.height) - z
        return float(max(across.max(), down.max()))


def through(cameras: Sequence[Camera], frames: int) -> list[Camera]:
    """A smooth path through cameras, as long from each to the next, with the size of the first; of
    one camera that camera alone.
    """
    if len(cameras) == 1:
        return list(cameras)
    first, times = cameras[0], np.linspace(0, len(cameras) - 1, frames)
    at = np.arange(len(cameras))
    eyes = CubicSpline(at, [camera.eye for camera in cameras])(times)
    axes = np.stack([camera.pose[:, :3] for camera in cameras])
    turns = RotationSpline(at, Rotation.from_matrix(axes))(times).as_matrix()
    widths = np.interp(times, at, [camera.fx / camera.width for camera in cameras])
    return [
        replace(first.with_angle(2 * math.atan(0.5 / width)), pose=np.column_stack([turn, eye]))
        for turn, eye, width in zip(turns, eyes, widths, strict=True)
    ]


def between(cameras: Sequence[Camera]) -> list[Camera]:
    """For each camera, one half-way to another around what they look at, which it shows in the same
    pixel: in turn to the nearest, the second, the third and the fourth of all directions. A camera
    that has none on its side is itself.
    """
    centre = looked_at(cameras)
    offsets = np.stack([camera.eye - centre for camera in cameras])
    distances = np.linalg.norm(offsets, axis=1)
    directions = offsets / np.maximum(distances, np.finfo(float).tiny)[:, None]
    found = []
    for i, camera in enumerate(cameras):
        cosines = directions @ directions[i]
        nearest = [j for j in np.argsort(-cosines, kind="stable") if j != i and cosines[j] > 0]
        if not nearest:
            found.append(camera)
            continue
        j = nearest[i % min(len(nearest), NEIGHBOURS)]
        turn, _ = Rotation.align_vectors([directions[i] + directions[j]], [directions[i]])
        scale = (1 + distances[j] / distances[i]) / 2
        pose = np.column_stack([camera.pose[:, :3], scale * offsets[i]])
        pose = turn.as_matrix() @ pose + np.pad(centre[:, None], ((0, 0), (3, 0)))
        found.append(replace(camera, pose=pose))
    return found


def level(vector: np.ndarray, up: np.ndarray) -> np.ndarray:
    """(3,) unit vector across `up` towards which a vector leans, some other where it does not."""
    across = vector - vector @ up * up
    if np.linalg.norm(across) <= 1e-6 * np.linalg.norm(vector):
        across = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    return across / np.linalg.norm(across)
