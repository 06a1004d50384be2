"""Camera paths: around an object, following the cameras of its images, or through given cameras."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from pp_cl import Camera
from pp_cl.scene import looked_at, up_of

MARGIN = 0.95  # share of the image that the object may fill
HIGHEST = math.radians(60)  # elevation of an orbit or spiral; near the poles an image would spin
TURNS = 2  # turns of a spiral
RING = math.radians(15)  # least range of elevations for TURNS; with less, a spiral makes one turn
NEIGHBOURS = 4  # between() goes towards the nearest cameras, at most this many
SAMPLED_POINTS = 20_000


def around(
    path: str, cameras: Sequence[Camera], points: np.ndarray, camera: Camera, frames: int
) -> list[Camera]:
    """Return `frames` cameras, with the size and angle of view of `camera`, that look at the middle
    of an object from one distance: that of its images, or farther if the object would be cut off.

    path: orbit, a circle at the images' median elevation that begins where the first was taken and
    ends one step before it; spiral, two turns from the lowest tenth of the elevations to the
    highest, or one turn if these are within RING. cameras: those of the images. points: (N, 3)
    points of the object, in the world.
    """
    up, centre = up_of(cameras), (points.min(axis=0) + points.max(axis=0)) / 2
    points = points[:: max(1, len(points) // SAMPLED_POINTS)] - centre
    offsets = np.array([view_camera.eye - centre for view_camera in cameras])
    distances = np.linalg.norm(offsets, axis=1)
    elevations = np.arcsin(np.clip(offsets @ up / distances, -1, 1)).clip(-HIGHEST, HIGHEST)
    ahead = level(offsets[0], up)
    aside = np.cross(up, ahead)
    angles, low = 2 * math.pi * np.arange(frames) / frames, np.median(elevations)
    high = low
    if path == "spiral":
        low, high = np.quantile(elevations, [0.1, 0.9])
        angles *= TURNS if high - low >= RING else 1
    towards = [
        math.cos(e) * (math.cos(a) * ahead + math.sin(a) * aside) + math.sin(e) * up
        for a, e in zip(angles, np.linspace(low, high, frames), strict=True)
    ]
    centred = replace(camera, cx=camera.width / 2, cy=camera.height / 2)
    size = {"width": camera.width, "height": camera.height}
    poses = [Camera.look_at(offset, (0, 0, 0), up, fx=camera.fx, **size).pose for offset in towards]
    distance = float(np.median(distances))
    for pose in poses:  # move back until all points are in the image
        x, y, z = (points @ pose[:, :3]).T
        across = np.abs(x) * 2 * camera.fx / (MARGIN * camera.width) - z
        down = np.abs(y) * 2 * camera.fy / (MARGIN * camera.height) - z
        distance = max(distance, float(across.max()), float(down.max()))
    return [
        replace(centred, pose=np.column_stack([pose[:, :3], centre + distance * offset]))
        for pose, offset in zip(poses, towards, strict=True)
    ]


def through(cameras: Sequence[Camera], frames: int) -> list[Camera]:
    """A smooth path of `frames` cameras through others, equally long from each to the next, in the
    size of the first; a single camera is returned alone.
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
    """For each camera, one half-way around the object towards another camera: in turn the nearest,
    second, third or fourth in direction. The point that cameras look at keeps its pixel. A camera
    with no other on its side is returned unchanged.
    """
    centre = looked_at(cameras)
    offsets = np.stack([camera.eye - centre for camera in cameras])
    distances = np.linalg.norm(offsets, axis=1)
    directions = offsets / np.maximum(distances, np.finfo(float).tiny)[:, None]
    halfway = []
    for i, camera in enumerate(cameras):
        cosines = directions @ directions[i]
        nearest = [j for j in np.argsort(-cosines, kind="stable") if j != i and cosines[j] > 0]
        if not nearest:
            halfway.append(camera)
            continue
        j = nearest[i % min(len(nearest), NEIGHBOURS)]
        turn, _ = Rotation.align_vectors([directions[i] + directions[j]], [directions[i]])
        scale = (1 + distances[j] / distances[i]) / 2
        pose = np.column_stack([camera.pose[:, :3], scale * offsets[i]])
        pose = turn.as_matrix() @ pose + np.pad(centre[:, None], ((0, 0), (3, 0)))
        halfway.append(replace(camera, pose=pose))
    return halfway


def level(vector: np.ndarray, up: np.ndarray) -> np.ndarray:
    """(3,) unit vector across `up` towards which a vector leans, or any if it does not."""
    across = vector - vector @ up * up
    if np.linalg.norm(across) <= 1e-6 * np.linalg.norm(vector):
        across = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    return across / np.linalg.norm(across)
