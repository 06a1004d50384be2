"""Writes a run as 3D Gaussians without network: 3D Gaussian splatting's .ply, .spz, and glTF."""

import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pp_cl import Run
from pp_cl.files import atomic_path
from pp_cl.scene import up_of
from pp_studio.export import QUICK
from pp_studio.export.gaussians import CONSTANT, FACTORS, ORDER, fitted_gaussians
from pp_studio.export.gltf import gltf_colours, write_glb
from pp_studio.export.harmonics import COUNT, basis
from pp_studio.export.points import in_world, inside, write_vertices

# In a .spz: steps of places in the widest deviation of the smallest Gaussian; the step of harmonics
# above degree 0, half of all bytes, a multiple of 1/128, its unit. With 1/16 they take 4 % more,
# and lego loses 0.05 dB less; two steps, one for each degree, take more bytes than their mean.
STEPS_OF_PLACE = 1
STEP_OF_HARMONICS = 5 / 64
# Limits of a .spz: places below 2^19, and deviations of 8 bits from e^-10 to 380. If Gaussians
# usually are at least LEAST_WIDTH wide, it is hardly seen that a .spz thickens the others.
MOST_PLACE, LEAST_WIDTH, MOST_WIDTH = 5e5, 2e-4, 380.0
STORED = 16  # functions in a .ply: many programs read only files of degree 3
Y_DOWN, Y_UP = (0.0, -1.0, 0.0), (0.0, 1.0, 0.0)  # the up directions of a .ply and of glTF


def splats(
    run: Run, turn: np.ndarray, quality: str | None = QUICK, box: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """((M,) records of GAUSSIAN, (3,) origin): fitted_gaussians() of a quality, turned by (3, 3);
    all, or those in a box (2, 3) of the scene. The origin is 0 unless float32 is too coarse there.
    Raises UserError as fitted_gaussians() and inside() do.
    """
    table, centre, *_ = fitted_gaussians(run, quality)
    positions = table["position"] + centre
    held = inside(positions, box)
    table, positions = table[held], positions[held] @ turn.T
    near = in_world(positions, run.model.grid.voxel_size).dtype == np.float32
    origin = np.zeros(3) if near else np.rint(positions.mean(0))
    table["position"] = positions - origin
    # solve for the coefficients in turned directions, from a sample of directions
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before, after = (basis(d)[:, ORDER] * FACTORS for d in (directions, directions @ turn.T))
    matrix = np.linalg.lstsq(after, before, rcond=None)[0]
    table["harmonics"] = np.einsum("jk,nkc->njc", matrix, table["harmonics"])
    axes = Rotation.from_matrix(turn) * Rotation.from_quat(np.roll(table["turn"], -1, axis=1))
    table["turn"] = np.roll(axes.as_quat(), 1, axis=1)
    return table, origin


def upright(run: Run, up: tuple[float, float, float]) -> np.ndarray:
    """(3, 3) rotation that turns the up direction of the training views to `up`."""
    return Rotation.align_vectors([up], [up_of(run.cameras("train"))])[0].as_matrix()


def write_splat_ply(path: Path | str, table: np.ndarray) -> None:
    """Write splats() in 3D Gaussian splatting's own format. Raises UserError as atomic_file."""
    nothing = np.zeros(len(table), np.float32)
    columns = dict(zip(("x", "y", "z"), table["position"].T, strict=True))
    columns |= dict.fromkeys(("nx", "ny", "nz"), nothing)
    harmonics = np.zeros((len(table), STORED, 3), np.float32)
    harmonics[:, :COUNT] = table["harmonics"]
    columns |= {f"f_dc_{c}": harmonics[:, 0, c] for c in range(3)}
    rest = harmonics[:, 1:].transpose(2, 1, 0).reshape(-1, len(table))  # channel by channel
    columns |= {f"f_rest_{i}": column for i, column in enumerate(rest)}
    columns["opacity"] = np.log(table["opacity"] / (1 - table["opacity"]))
    columns |= {f"scale_{i}": np.log(table["deviations"][:, i]) for i in range(3)}
    columns |= {f"rot_{i}": table["turn"][:, i] for i in range(4)}
    # brush turns a model upright by this comment; others take y as the vertical axis anyway
    write_vertices(path, columns, comments=["Vertical axis: y"])


def in_spz(table: np.ndarray) -> tuple[np.ndarray, float]:
    """(splats() in units that a .spz can hold, the factor to these units): 1, or a power of ten if
    the scene is far too large or too small.
    """
    widest = table["deviations"].max(axis=1)
    too_large = max(np.abs(table["position"]).max() / MOST_PLACE, widest.max() / MOST_WIDTH, 1)
    too_small = max(LEAST_WIDTH / np.median(widest), 1)
    times = 10.0 ** (math.ceil(math.log10(too_small)) - math.ceil(math.log10(too_large)))
    scaled = table.copy()
    for name in ("position", "deviations"):
        scaled[name] *= times
    return scaled, times


def cut_in_spz(table: np.ndarray) -> str:
    """What a .spz clips from splats(), in words; "" if nothing."""
    over = np.abs(table["harmonics"][:, 1:]) - 1  # excess of colours by direction
    if not (over > 0).any():
        return ""
    share, most = (over > 0).mean(), over.max()
    return f", {share:.2%} of its colours by direction clipped, by {most:.2f} at most"


def write_splat_spz(path: Path, table: np.ndarray) -> None:
    """Write splats() with y up, scaled by in_spz(), as .spz. Raises UserError as atomic_path."""
    from gsply import GSData, write_spz

    place = table["position"]
    rest = np.rint(table["harmonics"][:, 1:] / STEP_OF_HARMONICS) * STEP_OF_HARMONICS
    data = GSData.from_arrays(
        np.ascontiguousarray(place),
        np.log(table["deviations"]),
        table["turn"].copy(),
        np.log(table["opacity"] / (1 - table["opacity"])),
        np.ascontiguousarray(table["harmonics"][:, 0]),
        rest,
        format="ply",
    )
    # places are signed fixed-point numbers of 24 bits with 4 to 23 fractional bits
    bits = 4, min(23, 23 - math.ceil(math.log2(np.abs(place).max(initial=1e-6) * 1.001)))
    widest = table["deviations"].max(axis=1)
    wanted = math.ceil(math.log2(STEPS_OF_PLACE / widest.min(initial=1)))
    with atomic_path(path) as temporary:
        write_spz(temporary, data, fractional_bits=int(np.clip(wanted, *bits)))
        with temporary.open("r+b") as file:  # clear gzip's time stamp, the one part that differs
            file.seek(4)
            file.write(bytes(4))


def write_splat_glb(path: Path | str, table: np.ndarray, origin: np.ndarray) -> None:
    """Write splats() as glTF 2.0 (KHR_gaussian_splatting). Raises UserError as atomic_file."""
    extension, place = "KHR_gaussian_splatting", table["position"]
    attributes = {
        "POSITION": place + origin if origin.any() else place,
        # for programs that draw points instead
        "COLOR_0": gltf_colours(0.5 + CONSTANT * table["harmonics"][:, 0]),
        f"{extension}:ROTATION": np.roll(table["turn"], -1, axis=1),  # x, y, z, w
        f"{extension}:SCALE": table["deviations"].copy(),
        f"{extension}:OPACITY": table["opacity"],
    }
    for k in range(COUNT):
        degree = int(k**0.5)
        name = f"{extension}:SH_DEGREE_{degree}_COEF_{k - degree**2}"
        attributes[name] = table["harmonics"][:, k]
    kernel = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    write_glb(path, attributes, extension=(extension, kernel))
