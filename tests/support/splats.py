"""Draws the .ply of 3D Gaussian splatting as its paper and code do: project, sort, blend."""

import numpy as np
import plyfile
from scipy.spatial.transform import Rotation

LOW_PASS, LEAST, MOST, NEAR = 0.3, 1 / 255, 0.99, 0.2


def read_splats(path):
    """Read a file as {name: array}: positions (N, 3), harmonics (N, 16, 3), opacity (N,) and
    covariance (N, 3, 3).
    """
    vertex = plyfile.PlyData.read(str(path))["vertex"]

    def columns(name, count):
        return np.stack([vertex[f"{name}_{i}"] for i in range(count)], 1).astype(np.float64)

    rest = columns("f_rest", 45).reshape(-1, 3, 15).transpose(0, 2, 1)
    turn = Rotation.from_quat(np.roll(columns("rot", 4), -1, axis=1)).as_matrix()
    axes = turn * np.exp(columns("scale", 3))[:, None]
    return {
        "positions": np.stack([vertex[name] for name in "xyz"], 1).astype(np.float64),
        "harmonics": np.concatenate([columns("f_dc", 3)[:, None], rest], 1),
        "opacity": 1 / (1 + np.exp(-vertex["opacity"].astype(np.float64))),
        "covariance": axes @ axes.transpose(0, 2, 1),
    }


def colours(harmonics, towards):
    """(N, 3) colours from harmonics of degrees 0 to 2 in unit directions (N, 3) from the eye."""
    x, y, z = towards.T
    basis = [0.28209479177387814 + 0 * x]
    basis += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    basis += [1.0925484305920792 * x * y, -1.0925484305920792 * y * z]
    basis += [0.31539156525252005 * (2 * z * z - x * x - y * y)]
    basis += [-1.0925484305920792 * x * z, 0.5462742152960396 * (x * x - y * y)]
    return np.maximum(0.5 + np.einsum("kn,nkc->nc", basis, harmonics[:, :9]), 0)


def splats_of(table, origin):
    """Convert records of GAUSSIAN to the arrays of read_splats()."""
    turn = Rotation.from_quat(np.roll(table["turn"], -1, axis=1)).as_matrix()
    axes = turn * table["deviations"].astype(np.float64)[:, None]
    return {
        "positions": table["position"].astype(np.float64) + origin,
        "harmonics": table["harmonics"].astype(np.float64),
        "opacity": table["opacity"].astype(np.float64),
        "covariance": axes @ axes.transpose(0, 2, 1),
    }


def draw_splats(splats, camera, low_pass=LOW_PASS, widened=LOW_PASS):
    """(H, W, 3) image that a Camera sees of read_splats() over white. low_pass: pixels^2 by which
    the fit widened the variances; widened: pixels^2 by which this drawing does, with peaks lowered
    to match.
    """
    axes = camera.pose[:, :3].T
    at = (splats["positions"] - camera.eye) @ axes.T
    order = np.argsort(at[:, 2], kind="stable")
    order = order[at[order, 2] > NEAR]
    (x, y, z), n = at[order].T, len(order)
    limits = 1.3 * np.array([camera.width / 2 / camera.fx, camera.height / 2 / camera.fy])
    jacobian = np.zeros((n, 2, 3))
    for axis, focal in enumerate((camera.fx, camera.fy)):
        slope = np.clip(at[order, axis] / z, -limits[axis], limits[axis])
        jacobian[:, axis, axis], jacobian[:, axis, 2] = focal / z, -focal * slope / z
    jacobian = jacobian @ axes
    flat = jacobian @ splats["covariance"][order] @ jacobian.transpose(0, 2, 1)
    spread = flat + widened * np.eye(2)
    before = np.linalg.det(flat + low_pass * np.eye(2))
    opacity = splats["opacity"][order] * np.sqrt(before / np.linalg.det(spread))
    inverse = np.linalg.inv(spread)
    centre = np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], 1)
    size = np.array([camera.width, camera.height])
    reach = 3.4 * np.sqrt(spread[:, [0, 1], [0, 1]])
    first = np.clip(np.floor(centre - reach), 0, size).astype(int)
    sides = (np.clip(np.floor(centre + reach) + 1, 0, size).astype(int) - first).clip(0)
    count = sides.prod(axis=1)
    rank = np.repeat(np.arange(n), count)  # for each pixel of the boxes
    place = np.arange(len(rank)) - np.repeat(np.cumsum(count) - count, count)
    column, row = first[rank].T + np.stack([place % sides[rank, 0], place // sides[rank, 0]])
    away = np.stack([column, row], 1) + 0.5 - centre[rank]
    falloff = np.exp(-0.5 * np.einsum("ni,nij,nj->n", away, inverse[rank], away))
    alpha = np.minimum(MOST, opacity[rank] * falloff)
    hit = alpha >= LEAST
    pixel, rank, alpha = (row * camera.width + column)[hit], rank[hit], alpha[hit]
    sort = np.lexsort((rank, pixel))
    pixel, rank, alpha = pixel[sort], rank[sort], alpha[sort]
    through = np.concatenate([[0], np.cumsum(np.log1p(-alpha))])  # log of the light let through
    count = camera.width * camera.height
    begin = np.searchsorted(pixel, np.arange(count + 1))
    weight = alpha * np.exp(through[:-1] - through[begin[pixel]])
    towards = splats["positions"][order] - camera.eye
    colour = colours(
        splats["harmonics"][order], towards / np.linalg.norm(towards, axis=1, keepdims=True)
    )[rank]
    image = [np.bincount(pixel, weight * colour[:, c], minlength=count) for c in range(3)]
    white = 1 - np.bincount(pixel, weight, minlength=count)
    return (np.stack(image, 1) + white[:, None]).reshape(camera.height, camera.width, 3).clip(0, 1)
