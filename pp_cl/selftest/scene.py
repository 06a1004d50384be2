"""Cases of the kernels that prepare a scene: hull, targets, distortion, the demo."""

import itertools
from dataclasses import replace

import numpy as np

from pp_cl.engine.camera import Camera
from pp_cl.engine.grid import Grid
from pp_cl.engine.training.target import Target
from pp_cl.engine.views import MASK_THRESHOLD, View
from pp_cl.reference import scene as twin
from pp_cl.scene.demo import distances
from pp_cl.scene.hull import Carver
from pp_cl.scene.lens import LensDistortion, undistort
from pp_cl.selftest.case import SIZES, Case, absolute, exact

BORDER = 1e-4  # pixels from a pixel border within which float32 may choose the other pixel
TARGET = 5e-7  # a few roundings of a float32 in [0, 1]
ROUNDED = 0.5 + 0.1  # levels: 8 bits round by half; float32's 2e-4 pixels add 0.1 in steep noise
LENSES = (
    LensDistortion(-0.15, 0.04, 0.004, -0.003, 0.01),
    LensDistortion(k1=0.3),
    LensDistortion(k1=0.5, k2=0.1, k4=0.4, k5=0.05, k6=-0.01),
    LensDistortion(0.04, -0.02, 0.0, 0.0, 0.01, -0.004, fisheye=True),
)
DEMO = 2e-6  # distances of up to 2 have some ten roundings


def _views(rng, share):
    """Views of three sizes, one of them close, with a random `share` of the pixels in the mask."""
    views = []
    for eye, (width, height) in (
        ((3.0, 1, 0.5), (64, 48)),
        ((-2.0, 2, 1), (31, 33)),
        ((0.3, -0.4, 0.2), (40, 257)),
    ):
        size = {"fx": 1.5 * width, "width": width, "height": height}
        camera = Camera.look_at(eye, (0, 0, 0), (0.3, 0.2, 1), **size)
        inside = rng.random((height, width, 1)) < share
        if width == height - 2:
            inside[[0, -1]] = inside[:, [0, -1]] = False  # the object ends within the image
        image = np.where(inside, MASK_THRESHOLD + 1, MASK_THRESHOLD).repeat(4, 2).astype(np.uint8)
        views.append(View("noise", camera, image))
    return views


def _masks(dev, rng):
    """Masks widened by two pixels, or by more for a reduced image, and packed into bits."""
    for view, downscale in itertools.product(_views(rng, 0.002), (1, 2, 35)):
        height, width = view.image.shape[:2]
        words = Carver(dev, [replace(view, downscale=downscale)]).masks.get().reshape(height, -1)
        bits = np.unpackbits(words.view(np.uint8), axis=-1, bitorder="little")[:, :width]
        yield exact(bits, twin.dilated_mask(view.image[..., 3], MASK_THRESHOLD, 1 + downscale))


def _hull(dev, rng):
    """The vertices that enough images see and few enough masks reject, and their numbers."""
    views = _views(rng, 0.05)
    carver = Carver(dev, views)
    for nx, forgiven, carver.doubts in itertools.product(SIZES, (0, 1, 2), (0, 1)):
        voxel_size, ny, nz = 2 / nx, 7, 5
        origin = -voxel_size * np.array([nx, ny, nz]) / 2 + [0, 0, 0.1]
        grid = Grid(tuple(origin), voxel_size, (nx, ny, nz))
        positions = grid.lattice()
        rule = {"least": carver.least, "forgiven": forgiven, "doubts": bool(carver.doubts)}
        expected, border = twin.in_hull(views, positions, MASK_THRESHOLD, **rule)
        carved = carver.carve(grid, forgiven).ravel()
        yield exact(carved[border > BORDER], expected[border > BORDER])


def _target(dev, rng):
    """Means over white of blocks of pixels, some of which reach outside the image."""
    image = rng.integers(0, 256, (83, 97, 4), np.uint8)
    image[..., 3] = rng.choice([0, 255, 7, 130], (83, 97), p=[0.33, 0.33, 0.17, 0.17])
    view = View("noise", Camera(np.eye(3, 4), 90.0, 95.0, 45.6, 45.7, 97, 83), image)
    target = Target(dev)
    black = np.concatenate([np.zeros_like(image[..., :3]), image[..., 3:]], axis=2)
    for width, height in ((1, 5), (31, 5), (33, 5), (5, 31), (257, 5)):
        crop = {"width": width, "height": height}
        box = (1, 2, width, height)
        expected = twin.target_forward(image, 3, 3 + 2, 6 + 1, **crop)
        colour, alpha = target.crop(view.reduced(3), box, (2, 1))
        yield absolute(colour.get(), expected, TARGET)
        # over white, a black object hides as much as the object's share
        hidden = 1 - twin.target_forward(black, 3, 3 + 2, 6 + 1, **crop)[..., 0]
        yield absolute(alpha.get(), hidden, TARGET)


def _target_between(dev, rng):
    """Targets shifted by parts of a pixel, also if the crop reaches outside the image."""
    image = rng.integers(0, 256, (40, 97, 4), np.uint8)
    view = View("noise", Camera(np.eye(3, 4), 90.0, 95.0, 45.6, 20.2, 97, 40), image)
    target = Target(dev)
    for (width, height), (across, down) in itertools.product(
        ((1, 5), (31, 5), (33, 5), (5, 31), (257, 5)), ((0.125, -0.1), (-0.45, 0.3), (0.0, 0.4))
    ):
        for x0, y0 in ((1, 2), (-3, 33)):
            crop = target.crop(view, (x0, y0, width, height), (across, down))
            expected = twin.target_between(
                image, x0 + across, y0 + down, width=width, height=height
            )
            yield absolute(crop[0].get(), expected[..., :3], TARGET)
            yield absolute(crop[1].get(), expected[..., 3], TARGET)
    nothing = replace(view, image=image * np.array([1, 1, 1, 0], np.uint8))
    for jitter in rng.uniform(-0.125, 0.125, (20, 2)):
        crop = target.crop(nothing, (-3, -3, 60, 33), tuple(jitter))
        yield exact(crop[0].get(), np.ones((33, 60, 3)))


def _distortion(dev, rng):
    """Images of noise, at full size and reduced two and three times; a tall one takes several
    bands.
    """
    sizes = [(n, 31) for n in SIZES] + [(33, 257), (1030, 700)]
    for (width, height), lens in itertools.product(sizes, LENSES):
        camera = Camera(np.eye(3, 4), 0.9 * height, 0.8 * height, 0.53 * width, 14.2, width, height)
        image = rng.integers(0, 256, (height, width, 4), np.uint8)
        image[..., 3] = rng.integers(128, 256, (height, width))
        for factor in range(1, 2 if width < 3 or height > 300 else 4):
            undistorted = undistort(dev, image, camera, lens, factor)
            yield absolute(undistorted, twin.undistorted(image, camera, lens, factor), ROUNDED)


def _transparent(dev, rng):
    """A lens without distortion, over pixels some of which are transparent; these become black."""
    image = rng.integers(0, 256, (31, 33, 4), np.uint8)
    image[..., 3] *= rng.random((31, 33)) < 0.5
    camera, lens = Camera(np.eye(3, 4), 30.0, 30.0, 16.5, 15.5, 33, 31), LensDistortion()
    alpha = image[..., 3:].astype(np.float32)
    naive = np.concatenate([image[..., :3] * alpha / alpha, alpha], 2)
    expected = twin.undistorted(image, camera, lens)
    yield absolute(undistort(dev, image, camera, lens), expected, ROUNDED, naive=naive)


def _demo(dev, rng):
    for n in SIZES:
        for start in ((-0.8, 0.02, 0.1), (-0.5, -0.45, -0.9)):
            grid = Grid(start, 1.6 / n, (n, 1, 1))
            expected = twin.distance(grid.lattice())
            yield absolute(distances(dev, grid).ravel(), expected, DEMO)


CASES = (
    Case("scene: masks", _masks),
    Case("scene: hull", _hull),
    Case("scene: target", _target),
    Case("scene: target between pixels", _target_between),
    Case("scene: lens", _distortion),
    Case("scene: transparent pixels", _transparent, hard="colours divided by alpha, 0"),
    Case("scene: demo", _demo),
)
