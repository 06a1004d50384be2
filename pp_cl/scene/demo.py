"""The scene `demo`: images and a mesh of an object that cl/scene/demo.cl defines, so that there is
nothing to download.
"""

import math

import numpy as np

from pp_cl.engine.camera import Camera
from pp_cl.engine.device.device import Device
from pp_cl.engine.device.launch import lanes
from pp_cl.engine.grid import Grid
from pp_cl.engine.views import View, evenly
from pp_cl.errors import UserError
from pp_cl.scene.image_file import ImageFile

SPLITS = ("train", "test")
SIZE = 400  # pixels
ANGLE = 0.6911112  # of view across the image, radians, as in NeRF-synthetic
DISTANCE = 3.4  # of the cameras from the origin; the object fills the image
TRAIN_VIEWS, TEST_VIEWS = 64, 16
NO_DEPTH_RANGE = (0.0, math.inf)  # the rays are traced through the whole object
OBJECT_BOX = ((-0.8, -0.8, -1.0), (0.8, 0.8, 0.92))  # holds the object


def demo_views(dev: Device, split: str, most: int | None = None, size: int = SIZE) -> list[View]:
    """The 64 training or 16 test views, or at most `most` of them, spread evenly, rendered on the
    device with size x size pixels.
    """
    return [
        View(frame.name, frame.camera, render(dev, frame.camera))
        for frame in evenly(demo_frames(split, size), most)
    ]


def demo_frames(split: str, size: int = SIZE) -> list[ImageFile]:
    """A split's views, without their images. Raises UserError if there is no such split."""
    if split not in SPLITS:
        raise UserError(f"demo has no split {split}; its splits are {', '.join(SPLITS)}")
    if split == "train":  # on a spiral whose steps have equal areas of the sphere
        heights = np.linspace(0.95, -0.15, TRAIN_VIEWS)
        angles = [(i * math.pi * (3 - math.sqrt(5)), math.asin(h)) for i, h in enumerate(heights)]
    else:  # around the object, rising and sinking twice, from 5 to 45 degrees
        turns = (np.arange(TEST_VIEWS) + 0.5) / TEST_VIEWS * 2 * math.pi
        angles = [(turn, math.radians(25 + 20 * math.sin(2 * turn))) for turn in turns]
    cameras = [_camera(*angle, size) for angle in angles]
    return [ImageFile(f"{split}/r_{i}.png", camera) for i, camera in enumerate(cameras)]


def render(dev: Device, camera: Camera) -> np.ndarray:
    """(H, W, 4) uint8 straight RGBA image of the object, from 4x4 rays per pixel."""
    image = dev.empty((camera.height, camera.width, 4), np.uint8)
    dev.program("scene/demo", LANES=lanes(dev)).launch(
        "render_demo",
        (camera.width, camera.height),
        width=camera.width,
        height=camera.height,
        camera=dev.upload(camera.packed(NO_DEPTH_RANGE)),
        image=image,
    )
    return image.get()


def demo_mesh(dev: Device, resolution: int = 256) -> tuple[np.ndarray, np.ndarray]:
    """((V, 3) float32 vertices, (F, 3) int32 faces, counter-clockwise from outside) of the object,
    found by marching cubes. resolution: grid vertices along the box's longest side.
    """
    from skimage.measure import marching_cubes  # takes long to import

    low, high = np.array(OBJECT_BOX)
    voxel_size = (high - low).max() / (resolution - 1)
    dims = tuple(int(n) for n in np.ceil((high - low) / voxel_size - 1e-6) + 1)
    vertices, faces, _, _ = marching_cubes(
        distances(dev, Grid(tuple(low), voxel_size, dims)), 0, gradient_direction="ascent"
    )
    return (low + voxel_size * vertices[:, ::-1]).astype(np.float32), faces


def distances(dev: Device, grid: Grid) -> np.ndarray:
    """(nz, ny, nx) float32 signed distances of a Grid's vertices to the object, negative inside."""
    n = math.prod(grid.dims)
    out = dev.empty((n,))
    dev.program("scene/demo", LANES=lanes(dev)).launch(
        "demo_distances",
        -(-n // lanes(dev)),
        n=n,
        grid=dev.upload(grid.packed()),
        distances=out,
    )
    return out.get().reshape(grid.dims[::-1])


def _camera(azimuth, elevation, size):
    """Camera at two angles in radians that looks at the origin; look_at() would round otherwise."""
    level = math.cos(elevation)
    forward = -np.array([math.cos(azimuth) * level, math.sin(azimuth) * level, math.sin(elevation)])
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    pose = np.column_stack([right, np.cross(forward, right), forward, -DISTANCE * forward])
    focal = 0.5 * size / math.tan(0.5 * ANGLE)
    return Camera(pose, focal, focal, size / 2, size / 2, size, size)
