"""The demo's object in a textured room, as photographs for COLMAP, and how well COLMAP finds their
cameras.

    python -m tools.colmap_demo photographs FOLDER     # FOLDER/images and FOLDER/masks
    python -m tools.colmap_demo compare FOLDER         # the model in FOLDER/sparse/0 with the truth

Between the two, COLMAP without a GPU (docs/scenes.md).
"""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates

from pp_cl.device.device import Device
from pp_cl.device.discover import open_device
from pp_cl.errors import UserError
from pp_cl.files.atomic import atomic_folder
from pp_cl.files.image import write_png
from pp_cl.scene.camera import Camera
from pp_cl.scene.demo import demo_frames, render
from pp_cl.scene.readers.colmap import read_split
from tools.depth_error import pixel_rays

WIDER = 1.6  # angle of view, so that the room is seen around the object
ROOM = 6.0  # radius of the room, world units; the cameras are 3.4 from its middle
NOISE_CELLS, OCTAVES = 48, (1.5, 4.0, 10.0)  # cells per world unit of each layer of noise


@dataclass(frozen=True)
class Alignment:
    """How far found cameras are from the true ones after the best similarity. position: root mean
    square in world units; degrees: the largest rotation.
    """

    position: float
    degrees: float


def cameras(size: int) -> list[Camera]:
    """The demo's training cameras, with a wider angle of view."""
    found = [frame.camera for frame in demo_frames("train", size)]
    angle = 2 * np.arctan(0.5 * size / found[0].fx)
    return [camera.with_angle(WIDER * angle) for camera in found]


def room(camera: Camera) -> np.ndarray:
    """(H, W, 3) colours in [0, 1] of the room's wall: noise on a sphere around the origin."""
    rays = pixel_rays(camera)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    along = rays @ camera.eye
    distance = -along + np.sqrt(along**2 + ROOM**2 - camera.eye @ camera.eye)
    places = camera.eye + distance[..., None] * rays
    rng = np.random.default_rng(0)
    layers = []
    for cells in OCTAVES:
        noise = rng.uniform(0, 1, (3, NOISE_CELLS, NOISE_CELLS, NOISE_CELLS))
        at = np.moveaxis(places * cells, -1, 0)
        layers.append([map_coordinates(one, at, order=1, mode="grid-wrap") for one in noise])
    return np.moveaxis(np.mean(layers, axis=0), 0, -1)


def write_photographs(dev: Device, folder: Path, size: int) -> None:
    """Write the photographs and masks. Raises UserError for a folder that holds something."""
    with atomic_folder(folder) as unfinished:
        for name in ("images", "masks"):
            (unfinished / name).mkdir()
        for i, camera in enumerate(cameras(size)):
            rgba = render(dev, camera) / 255
            alpha = rgba[..., 3:]
            photograph = rgba[..., :3] * alpha + room(camera) * (1 - alpha)
            write_png(unfinished / "images" / f"{i:03d}.png", photograph)
            write_png(unfinished / "masks" / f"{i:03d}.png.png", rgba[..., 3])


def align(found: list[Camera], true: list[Camera]) -> Alignment:
    """The found cameras moved onto the true ones by a similarity (Umeyama 1991)."""
    eyes, targets = (np.stack([camera.eye for camera in some]) for some in (found, true))
    a, b = eyes - eyes.mean(0), targets - targets.mean(0)
    u, sizes, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1, 1, np.linalg.det(u @ vt)])
    rotation = (u * signs) @ vt
    scale = (sizes * signs).sum() / (a**2).sum()
    off = scale * a @ rotation.T - b
    turns = [
        np.trace(t.pose[:, :3].T @ rotation @ f.pose[:, :3])
        for f, t in zip(found, true, strict=True)
    ]
    angle = np.degrees(np.arccos(np.clip((min(turns) - 1) / 2, -1, 1)))
    return Alignment(float(np.sqrt((off**2).sum(1).mean())), float(angle))


def compare(folder: Path) -> tuple[int, Alignment]:
    """(images that COLMAP has placed, Alignment of their cameras). Raises UserError as the reader
    does.
    """
    photographs = [one for split in ("train", "test") for one in read_split(folder, split)]
    true = cameras(photographs[0].camera.width)
    places = [int(Path(one.name).stem) for one in photographs]
    return len(places), align([one.camera for one in photographs], [true[i] for i in places])


def main() -> int:
    """Returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("task", choices=["photographs", "compare"])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--size", type=int, default=400, help="side of the photographs (400)")
    options = parser.parse_args()
    try:
        if options.task == "photographs":
            write_photographs(open_device(), options.folder, options.size)
        else:
            count, found = compare(options.folder)
            print(f"{count} images; positions off by {found.position:.5f} world units (RMS),")
            print(f"directions by at most {found.degrees:.3f} degrees")
    except UserError as error:
        print(f"colmap_demo: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
