"""A run as 3D Gaussians without a network: the .ply of 3D Gaussian splatting, and glTF."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pp_cl.export.gltf import gltf_colours, write_glb
from pp_cl.export.harmonics import COUNT, basis, fit_harmonics
from pp_cl.export.page import check_drawable
from pp_cl.export.points import in_world, table_of, write_elements
from pp_cl.files.image import to_8bit
from pp_cl.run import Run
from pp_cl.scene.camera_path import up_of

# Of a Gaussian, in radii of the soft disc, whose alpha falls linearly to its rim: the root of its
# second moment. With the disc's opacity in the centre a Gaussian then covers 0.91 of the disc. The
# 0.3 pixels^2 that viewers add to its variance are not made up for: where a point covers a pixel,
# as in the training views, they make it three times as large, but opacities that suit those views
# leave gaps in larger windows.
DEVIATION = 0.39
MOST_OPAQUE, LEAST_OPAQUE = 0.99, 1 / 255  # what 3D Gaussian splatting clamps to, and leaves out
CONSTANT = 0.28209479177387814  # the first of the functions below
# 3D Gaussian splatting's functions of degrees 0 to 2 are basis()'s in this order, times these.
ORDER = [0, 2, 3, 1, 4, 5, 7, 6, 8]
FACTORS = np.array(
    [
        CONSTANT,
        *(-0.4886025119029199, 0.4886025119029199, -0.4886025119029199),
        *(1.0925484305920792, -1.0925484305920792, 0.31539156525252005),
        *(-1.0925484305920792, 0.5462742152960396),
    ]
)
STORED = 16  # functions in a .ply: many programs read no file but of degree 3
Y_DOWN, Y_UP = (0.0, -1.0, 0.0), (0.0, 1.0, 0.0)  # what is up in a .ply, and in glTF

SPLAT = np.dtype(
    [
        ("position", "<f4", 3),
        ("harmonics", "<f4", (COUNT, 3)),
        ("opacity", "<f4"),
        ("deviation", "<f4"),
    ]
)


def splats(run: Run, up: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """((M,) records of SPLAT, (3,) origin): the run's points as Gaussians, in the world of its
    scene turned so that its up, as far as the photographs tell, is `up`. Positions are relative to
    the origin, which is 0 unless float32 is too coarse there. harmonics: in the order and with the
    signs of 3D Gaussian splatting, of colours less 0.5, opacity: after the sigmoid. Points that no
    training view shows are left out.
    """
    check_drawable(run)
    coefficients = fit_harmonics(run)
    opacity = run.model.cloud.opacity.get().clip(0, MOST_OPAQUE)
    rows = np.flatnonzero((opacity > LEAST_OPAQUE) & coefficients.any((1, 2)))
    turn = Rotation.align_vectors([up], [up_of(run.cameras("train"))])[0].as_matrix()
    positions = run.model.positions()[rows] @ turn.T
    near = in_world(positions, run.model.grid.edge).dtype == np.float32
    origin = np.zeros(3) if near else np.rint(positions.mean(0))
    table = np.zeros(len(rows), SPLAT)
    table["position"] = positions - origin
    table["harmonics"] = _turned(coefficients[rows], turn)
    table["opacity"] = opacity[rows]
    table["deviation"] = DEVIATION * run.config.raster.radius * run.model.grid.edge
    table["deviation"] *= np.exp(run.model.cloud.offset.get()[rows, 3])
    return table, origin


def _turned(coefficients, turn):
    """(M, 9, 3) of basis() to those of 3D Gaussian splatting, of directions that are turned."""
    seen = np.random.default_rng(0).normal(size=(64, 3))
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    theirs = basis(seen @ turn.T)[:, ORDER] * FACTORS
    matrix = np.linalg.lstsq(theirs, basis(seen), rcond=None)[0]
    found = np.einsum("jk,nkc->njc", matrix, coefficients)
    found[:, 0] -= 0.5 / CONSTANT
    return found


def write_splat_ply(path: Path | str, table: np.ndarray) -> None:
    """Write splats() as the training code of 3D Gaussian splatting does. Raises UserError as
    atomic_file does.
    """
    nothing = np.zeros(len(table), np.float32)
    columns = dict(zip(("x", "y", "z"), table["position"].T, strict=True))
    columns |= dict.fromkeys(("nx", "ny", "nz"), nothing)
    harmonics = np.zeros((len(table), STORED, 3), np.float32)
    harmonics[:, :COUNT] = table["harmonics"]
    columns |= {f"f_dc_{c}": harmonics[:, 0, c] for c in range(3)}
    rest = harmonics[:, 1:].transpose(2, 1, 0).reshape(-1, len(table))  # all of a channel together
    columns |= {f"f_rest_{i}": column for i, column in enumerate(rest)}
    columns["opacity"] = np.log(table["opacity"] / (1 - table["opacity"]))
    columns |= dict.fromkeys(("scale_0", "scale_1", "scale_2"), np.log(table["deviation"]))
    columns |= {"rot_0": nothing + 1} | dict.fromkeys(("rot_1", "rot_2", "rot_3"), nothing)
    # brush turns a model by this comment; others take y for the vertical axis anyway
    write_elements(path, {"vertex": table_of(columns)}, ["Vertical axis: y"])


def write_splat_glb(path: Path | str, table: np.ndarray, origin: np.ndarray) -> None:
    """Write splats() and their origin as glTF 2.0 with KHR_gaussian_splatting. Raises UserError as
    atomic_file does.
    """
    extension, place = "KHR_gaussian_splatting", table["position"]
    attributes = {
        "POSITION": place + origin if origin.any() else place,
        # of programs that draw points instead
        "COLOR_0": gltf_colours(to_8bit(0.5 + CONSTANT * table["harmonics"][:, 0])),
        f"{extension}:ROTATION": np.tile(np.array([0, 0, 0, 1], np.float32), (len(table), 1)),
        f"{extension}:SCALE": table["deviation"].repeat(3).reshape(-1, 3),
        f"{extension}:OPACITY": table["opacity"],
    }
    for k in range(COUNT):
        degree = int(k**0.5)
        name = f"{extension}:SH_DEGREE_{degree}_COEF_{k - degree**2}"
        attributes[name] = table["harmonics"][:, k]
    kernel = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    write_glb(path, attributes, extension=(extension, kernel))
