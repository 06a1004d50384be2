"""Photograph the demo's object in a textured room, as input of `pp-cl capture`, and compare the
cameras of a scene with the true ones.

    python -m tools.capture_demo photographs FOLDER     # FOLDER/images and FOLDER/masks
    python -m tools.capture_demo video VIDEO.mp4        # the camera moves around the object
    python -m tools.capture_demo turntable FOLDER       # the object turns, camera and wall stay
    python -m tools.capture_demo compare SCENE KIND     # a scene made of one of these
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates

from pp_cl.drivers import open_device
from pp_cl.engine.camera import Camera
from pp_cl.engine.device.device import Device
from pp_cl.errors import UserError
from pp_cl.files.atomic import atomic_folder
from pp_cl.files.image import to_8bit, write_png
from pp_cl.scene.demo import ANGLE, DISTANCE, demo_frames, render
from pp_cl.scene.listing import scene_frames
from pp_studio.video import write_video

WIDER = 1.6  # factor of the angle of view, so that the room is seen around the object
ROOM = 6.0  # radius of the room, world units; the cameras are 3.4 from its middle
TURNED, STEPS = 0.35, 72  # elevation of the turntable's camera, radians; photographs of a turn
VIDEO_FRAMES, FPS, ROUNDS = 240, 24, 2
NOISE_CELLS, OCTAVES = 48, (1.5, 4.0, 10.0)  # cells per world unit of each layer of noise


@dataclass(frozen=True)
class Alignment:
    """How far found cameras are from the true ones after the best similarity. position: root mean
    square distance, world units; degrees: the largest rotation.
    """

    position: float
    degrees: float


def cameras(size: int, kind: str = "photographs") -> list[Camera]:
    """The cameras of the photographs. `photographs`: the demo's training cameras with a wider
    angle of view; `turntable`: around the object, which fills the image; `video`: wider, 16:9.
    """
    if kind == "turntable":
        return [_around(turn, TURNED, size, size, ANGLE) for turn in np.arange(STEPS) / STEPS]
    if kind == "video":
        shares = np.arange(VIDEO_FRAMES) / VIDEO_FRAMES
        return [_around(ROUNDS * s, 0.9 * s, size, size * 9 // 32 * 2) for s in shares]
    demo_cameras = [frame.camera for frame in demo_frames("train", size)]
    angle = 2 * np.arctan(0.5 * size / demo_cameras[0].fx)
    return [camera.with_angle(WIDER * angle) for camera in demo_cameras]


def _around(turn, elevation, width, height, angle=WIDER * ANGLE):
    """A camera that looks at the object. turn: share of a round. angle of view: radians."""
    azimuth, level = 2 * np.pi * turn, np.cos(elevation)
    eye = [np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(elevation)]
    focal = 0.5 * min(width, height) / np.tan(0.5 * angle)
    return Camera.look_at(DISTANCE * np.array(eye), (0, 0, 0), fx=focal, width=width, height=height)


def room(camera: Camera, octaves: Sequence[float] = OCTAVES) -> np.ndarray:
    """(H, W, 3) colours in [0, 1] of the room's wall: noise on a sphere around the origin.
    octaves: cells per world unit of each layer of noise.
    """
    rays = camera.rays()
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    along = rays @ camera.eye
    distance = -along + np.sqrt(along**2 + ROOM**2 - camera.eye @ camera.eye)
    places = camera.eye + distance[..., None] * rays
    rng = np.random.default_rng(0)
    layers = []
    for cells in octaves:
        noise = rng.uniform(0, 1, (3, NOISE_CELLS, NOISE_CELLS, NOISE_CELLS))
        at = np.moveaxis(places * cells, -1, 0)
        layers.append([map_coordinates(volume, at, order=1, mode="grid-wrap") for volume in noise])
    return np.moveaxis(np.mean(layers, axis=0), 0, -1)


def photographs(dev: Device, size: int, kind: str) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield each photograph: (H, W, 3) colours in [0, 1] and (H, W) uint8 mask."""
    taken = cameras(size, kind)
    still = room(taken[0]) if kind == "turntable" else None
    for camera in taken:
        rgba = render(dev, camera)
        alpha = rgba[..., 3:] / 255
        behind = room(camera) if still is None else still
        yield rgba[..., :3] / 255 * alpha + behind * (1 - alpha), rgba[..., 3]


def write_photographs(dev: Device, folder: Path, size: int, kind: str = "photographs") -> None:
    """Write photographs and masks. Raises UserError if the folder is not empty."""
    with atomic_folder(folder) as unfinished:
        for name in ("images", "masks"):
            (unfinished / name).mkdir()
        for i, (photograph, mask) in enumerate(photographs(dev, size, kind)):
            write_png(unfinished / "images" / f"{i:03d}.png", photograph)
            write_png(unfinished / "masks" / f"{i:03d}.png", mask)


def align(found: list[Camera], true: list[Camera]) -> Alignment:
    """Move the found cameras onto the true ones by a similarity (Umeyama 1991)."""
    eyes, targets = (np.stack([camera.eye for camera in group]) for group in (found, true))
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


def compare(folder: Path, kind: str) -> tuple[int, Alignment]:
    """(number of images with a camera, Alignment of these). Raises UserError as readers do."""
    placed = [frame for split in ("train", "test") for frame in scene_frames(folder, split)]
    true = cameras(placed[0].camera.width, kind)
    places = [int(Path(frame.name).stem) for frame in placed]
    return len(places), align([frame.camera for frame in placed], [true[i] for i in places])


def main() -> int:
    """Returns the exit status."""
    kinds = ["photographs", "video", "turntable"]
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("task", choices=[*kinds, "compare"])
    parser.add_argument("path", type=Path)
    parser.add_argument("kind", choices=kinds, nargs="?", default="photographs")
    parser.add_argument("--size", type=int, default=400, help="pixels across (400)")
    options = parser.parse_args()
    try:
        if options.task == "compare":
            count, alignment = compare(options.path, options.kind)
            print(f"{count} images; positions off by {alignment.position:.5f} world units (RMS),")
            print(f"directions by at most {alignment.degrees:.3f} degrees")
        elif options.task == "video":
            taken = photographs(open_device(), options.size, "video")
            write_video(options.path, (to_8bit(colours) for colours, _ in taken), FPS)
        else:
            write_photographs(open_device(), options.path, options.size, options.task)
    except UserError as error:
        print(f"capture_demo: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
