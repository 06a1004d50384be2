"""Float64 twins of project, blend and shade, which compute every point at every pixel, as (N, HW)
matrices. Pulsar's spheres exist only here: the twins are compared with Pulsar itself, and the
kernels, for discs and Gaussians, with the twins.
"""

from typing import Any

import numpy as np

Arrays = dict[str, np.ndarray]

EPS = 1e-6
DEPTH_RANGE = (2.0, 6.0)  # (near, far) if a test gives no other
LEAST_RADIUS = 0.75
LEAST_STOP, LEAST_THROUGH = 1e-20, 2.0**-24  # of alpha compositing
LOW_PASS, DEVIATIONS, LEAST_ALPHA, MOST_ALPHA = 0.3, 3.33, 1 / 255, 0.99  # of Gaussians


def camera_space(camera: Any, positions: np.ndarray) -> np.ndarray:
    """(N, 3) positions in camera axes."""
    return (np.asarray(positions, np.float64) - camera.eye) @ camera.pose[:, :3]


def drawn(
    camera: Any,
    positions: np.ndarray,
    radius: np.ndarray | float,
    depth_range: tuple[float, float] = DEPTH_RANGE,
) -> np.ndarray:
    """(N,) bool: the point is finite, in front of the eye, and t - radius is in [near, far]."""
    near, far = depth_range
    with np.errstate(all="ignore"):
        c = camera_space(camera, positions)
        t = np.linalg.norm(c, axis=1)
        front = t - radius
        return np.isfinite(t) & (t > 0) & (front >= near) & (front <= far) & (c[:, 2] >= 1e-6 * t)


def rays(camera: Any) -> np.ndarray:
    """(HW, 3) unit rays through the pixel centres, in camera axes."""
    y, x = np.mgrid[: camera.height, : camera.width]
    r = np.stack(
        [(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, np.ones(x.shape)], -1
    ).reshape(-1, 3)
    return r / np.linalg.norm(r, axis=1, keepdims=True)


def surface_depth(
    camera: Any, geometry: Arrays, radius: np.ndarray | float, kind: str
) -> np.ndarray:
    """(N, HW) depth along the camera's axis at which a ray meets a point; for a soft point, the
    depth of its ball, computed from the falloff.
    """
    ranges, d = geometry["depth"], np.maximum(geometry["falloff"], 0)
    if kind == "soft":
        radius = np.broadcast_to(np.asarray(radius, np.float64), len(ranges))
        ranges = ranges - radius[:, None] * np.sqrt(d * (2 - d))
    return ranges * rays(camera)[:, 2]


def geometry(
    camera: Any,
    positions: np.ndarray,
    radius: np.ndarray | float,
    kind: str,
    *,
    covariance: np.ndarray | None = None,
    depth_range: tuple[float, float] = DEPTH_RANGE,
) -> Arrays:
    """Dict of (N, HW) arrays: fragment, falloff, depth, z (normalised depth), and margin (pixels by
    which the coverage test passes or fails). radius: (N,). covariance: (N, 3, 3) of Gaussians;
    None: round ones.
    """
    radius = np.broadcast_to(np.asarray(radius, np.float64), (len(positions),))
    c, r = camera_space(camera, positions), rays(camera)
    ok = drawn(camera, positions, radius, depth_range)
    c = np.where(ok[:, None], c, [0.0, 0.0, 1.0])
    t = np.linalg.norm(c, axis=1)[:, None]
    round_ones = radius[:, None, None] ** 2 * np.eye(3)
    radius, width = radius[:, None], t / min(camera.fx, camera.fy)  # of a pixel at range t
    least = LEAST_RADIUS * width
    if kind == "gaussian":
        away, inverse, peak = screen_gaussians(
            camera, c, round_ones if covariance is None else covariance
        )
        deviations = np.sqrt(np.einsum("nqi,nij,nqj->nq", away, inverse, away).clip(0))
        fragment = deviations < DEVIATIONS
        falloff = peak[:, None] * np.exp(-0.5 * deviations**2)
        depth = np.broadcast_to(c[:, 2:], fragment.shape)
        with np.errstate(divide="ignore"):
            margin = np.linalg.norm(away, axis=2) * np.abs(1 - DEVIATIONS / deviations)
    elif kind != "sphere":
        reach, ahead = np.maximum(radius, least), np.maximum(c @ r.T, 0)
        rho = np.linalg.norm(c[:, None] - ahead[..., None] * r[None], axis=2)
        fragment = (rho < reach) & (ahead > 0)
        falloff = 1 - rho / reach if kind == "soft" else np.ones_like(rho)
        depth = np.broadcast_to(t, rho.shape)
        margin = np.abs(rho - reach) / width
    else:
        rho = np.linalg.norm(c[:, None] - t[..., None] * r[None], axis=2)
        through = rho < least
        fragment = (rho <= radius) | through
        falloff = np.where(through & (radius < width), 1.0, np.clip(1 - rho / radius, 0, 1))
        along = np.minimum(c @ r.T, t)
        across = np.linalg.norm(c[:, None] - along[..., None] * r[None], axis=2)
        depth = along - np.sqrt(np.maximum(radius**2 - across**2, 0))
        margin = np.minimum(np.abs(rho - radius), np.abs(rho - least)) / width
        fragment &= pulsar_box(camera, c, radius[:, 0])
    near, far = depth_range
    return {
        "fragment": fragment & ok[:, None],
        "falloff": falloff,
        "depth": depth,
        "z": 1 - (depth - near) / (far - near),
        "margin": margin,
        "limits": (LEAST_ALPHA, MOST_ALPHA) if kind == "gaussian" else (-np.inf, np.inf),
    }


def gaussians(
    camera: Any, vertices: np.ndarray, voxel_size: float, offset: np.ndarray, radius: float
) -> Arrays:
    """geometry() for Gaussians at vertices (N, 3) of a grid; offset: (N, 9), as in cl/cloud.h."""
    lower = np.zeros((len(offset), 3, 3))
    lower[:, range(3), range(3)] = radius * np.exp(offset[:, 3:6])
    lower[:, [1, 2, 2], [0, 0, 1]] = radius * offset[:, 6:9]
    positions = vertices + voxel_size * offset[:, :3]
    covariance = lower @ lower.transpose(0, 2, 1)
    return geometry(camera, positions, radius, "gaussian", covariance=covariance)


def screen_gaussians(
    camera: Any, c: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """((N, HW, 2) vectors from centres of Gaussians to centres of pixels, (N, 2, 2) inverse
    covariances on the screen, (N,) falloff in the centre). c: (N, 3) in camera axes. covariance:
    (N, 3, 3) in world axes.
    """
    (x, y, z), focal = c.T, (camera.fx, camera.fy)
    jacobian = np.zeros((len(c), 2, 3))
    for axis, place in enumerate((x, y)):
        jacobian[:, axis, axis] = focal[axis] / z
        jacobian[:, axis, 2] = -focal[axis] * place / z**2
    jacobian = jacobian @ camera.pose[:, :3].T
    least = jacobian @ covariance @ jacobian.transpose(0, 2, 1)
    least += LOW_PASS / camera.samples**2 * np.eye(2)
    spread = least + (1 - camera.samples**-2) / 12 * np.eye(2)
    peak = np.sqrt(np.linalg.det(least) / np.linalg.det(spread))
    centre = np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], 1)
    row, column = np.mgrid[: camera.height, : camera.width]
    pixels = np.stack([column, row], -1).reshape(-1, 2) + 0.5
    return pixels - centre[:, None], np.linalg.inv(spread), peak


def pulsar_box(camera: Any, c: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """(N, HW) bool: the pixel is in Pulsar's box of the sphere, unbounded if that meets the eye's
    plane.
    """
    y, x = np.mgrid[: camera.height, : camera.width]
    inside = np.ones((len(c), x.size), bool)
    for u, focal, centre, pixel in (
        (c[:, 0], camera.fx, camera.cx, x),
        (c[:, 1], camera.fy, camera.cy, y),
    ):
        reach = np.hypot(u, c[:, 2])
        with np.errstate(divide="ignore", invalid="ignore"):
            alpha, theta = np.arctan2(u, c[:, 2]), np.arcsin(radius / reach)
        free = c[:, 2] <= radius
        low = np.where(free, -np.inf, np.floor(np.tan(alpha - theta) * focal + centre - 0.5))
        high = np.where(free, np.inf, np.ceil(np.tan(alpha + theta) * focal + centre - 0.5))
        inside &= (pixel.ravel() >= low[:, None]) & (pixel.ravel() <= high[:, None])
    return inside


def order(geometry_: Arrays) -> np.ndarray:
    """(N, HW) int: each fragment's rank in its pixel by (depth, index), from 0."""
    depth = np.where(geometry_["fragment"], geometry_["depth"], np.inf)
    return np.argsort(np.argsort(depth, axis=0, kind="stable"), axis=0)


def blend(geometry_: Arrays, opacity: np.ndarray, gamma: float, stop: float = 0.0) -> Arrays:
    """Dict: weight (N, HW) b; share (N, HW) b/o, or its limit at o = 0; by_opacity (N, HW), b times
    the derivative of its logarithm by o; z (N, HW); background (HW,) b_0; fragment (N, HW), the
    used ones.
    """
    fragment, d, z = geometry_["fragment"], geometry_["falloff"], geometry_["z"]
    o = np.asarray(opacity, np.float64)[:, None]
    if stop > 0:
        fragment = fragment & ~_stopped(geometry_, o, gamma, stop)
    with np.errstate(divide="ignore", invalid="ignore"):  # outside the fragments
        log_weight = np.where(fragment, np.log(o * d) + o * z / gamma, -np.inf)
        log_share = np.where(fragment, np.log(d) + o * z / gamma, -np.inf)
    m = np.maximum(EPS / gamma, log_weight.max(axis=0, initial=-np.inf))
    total = m + np.log(np.exp(EPS / gamma - m) + np.exp(log_weight - m).sum(axis=0))
    share = np.exp(log_share - total)
    return {
        "weight": np.exp(log_weight - total),
        "share": share,
        "by_opacity": share * (1 + o * z / gamma),
        "z": z,
        "fragment": fragment,
        "background": np.exp(EPS / gamma - total),
    }


def _stopped(geometry_, o, gamma, stop):
    """(N, HW) bool: fragments behind the early stop of their pixel."""
    fragment, d, z = geometry_["fragment"], geometry_["falloff"], geometry_["z"]
    result, ranks = np.zeros_like(fragment), order(geometry_)
    for q in np.flatnonzero(fragment.any(axis=0)):
        points = np.flatnonzero(fragment[:, q])
        points = points[np.argsort(ranks[points, q])]
        log_total = EPS / gamma
        for place, i in enumerate(points):
            if max(z[i, q], 0) / gamma < log_total + np.log(stop / (1 - stop)):
                result[points[place:], q] = True
                break
            with np.errstate(divide="ignore"):
                log_total = np.logaddexp(
                    log_total, np.log(o[i, 0] * d[i, q]) + o[i, 0] * z[i, q] / gamma
                )
    return result


def features(blend_: Arrays, point_features: np.ndarray) -> np.ndarray:
    """(HW, C) blended features over a background of 1."""
    return (
        blend_["weight"].T @ np.asarray(point_features, np.float64) + blend_["background"][:, None]
    )


def alpha(geometry_: Arrays, opacity: np.ndarray, least: float = 0.0) -> Arrays:
    """Dict of front-to-back compositing, (N, HW) each: alpha; weight b; through, the transmittance
    T in front; fragment, where T >= least; and background (HW,), T behind all of them.
    """
    fragment, ranks = geometry_["fragment"], order(geometry_)
    least_alpha, most_alpha = geometry_["limits"]
    alpha_ = np.asarray(opacity, np.float64)[:, None] * geometry_["falloff"]
    shows = alpha_ >= least_alpha
    alpha_ = np.where(shows, np.minimum(alpha_, most_alpha), 0)
    through = np.maximum(1 - alpha_, LEAST_THROUGH)
    factors = np.ones((len(fragment) + 1, fragment.shape[1]))  # by places, from 1
    np.put_along_axis(factors, ranks + 1, np.where(fragment, through, 1), axis=0)
    passed = np.cumprod(factors, axis=0)  # T in front of each
    through = np.take_along_axis(passed, ranks, axis=0)
    used = fragment & ~(through < least)
    through = np.where(used, through, 0)
    return {
        "alpha": alpha_,
        "shows": shows,
        "weight": through * alpha_,
        "through": through,
        "background": passed[used.sum(axis=0), np.arange(fragment.shape[1])],
        "fragment": used,
    }


def blend_by_rule(
    rule: str, geometry_: Arrays, opacity: np.ndarray, gamma: float, stop: float = 0.0
) -> Arrays:
    """alpha(), which stops at LEAST_STOP at the latest, or blend(). rule: "alpha" or "softmax"."""
    if rule == "alpha":
        return alpha(geometry_, opacity, max(stop, LEAST_STOP))
    return blend(geometry_, opacity, gamma, stop)


def distances(geometry_: Arrays, blend_: Arrays) -> np.ndarray:
    """(N, HW) sum_j b_j |z_i - z_j| over the used fragments; 0 elsewhere."""
    depth, weight, fragment = geometry_["depth"], blend_["weight"], blend_["fragment"]
    sums = np.zeros(fragment.shape)
    for q in np.flatnonzero(fragment.any(axis=0)):
        z = depth[fragment[:, q], q]
        sums[fragment[:, q], q] = np.abs(z[:, None] - z) @ weight[fragment[:, q], q]
    return sums


def distortion(geometry_: Arrays, blend_: Arrays) -> np.ndarray:
    """(HW,) sum_ij b_i b_j |z_i - z_j| over the used fragments (Mip-NeRF 360, Eq. 15)."""
    return (blend_["weight"] * distances(geometry_, blend_)).sum(axis=0)


def gradients(
    geometry_: Arrays,
    blend_: Arrays,
    point_features: np.ndarray,
    grad_features: np.ndarray,
    *,
    max_tracked: int = 0,
    distortion_weight: float = 0.0,
    depth_gradient: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """(dL/df (N, C), dL/do (N,)) through the tracked() fragments, given grad_features (HW, C).
    With alpha(), distortion_weight times the distortion loss is added, and a loss with
    depth_gradient (HW, 2): dL/db of a fragment over the difference of its depth and the second.
    """
    G, f = np.asarray(grad_features, np.float64), np.asarray(point_features, np.float64)
    own, ranks = f @ G.T, order(geometry_)
    if "through" in blend_:
        if distortion_weight:
            own += 2 * distortion_weight * distances(geometry_, blend_)
        if depth_gradient is not None:
            slope, mean = depth_gradient.T
            own += np.where(blend_["fragment"], slope * (geometry_["depth"] - mean), 0)
        derivative = _alpha_derivative(blend_, own, G.sum(axis=1), ranks) * geometry_["falloff"]
    else:
        derivative = blend_["by_opacity"] * (own - (G * features(blend_, f)).sum(axis=1))
    used = tracked(geometry_, blend_, max_tracked)
    return np.where(used, blend_["weight"], 0) @ G, np.where(used, derivative, 0).sum(axis=1)


def by_falloff(
    geometry_: Arrays,
    blend_: Arrays,
    opacity: np.ndarray,
    point_features: np.ndarray,
    grad_features: np.ndarray,
) -> np.ndarray:
    """(N, HW) dL/dd of alpha compositing, given grad_features (HW, C)."""
    G = np.asarray(grad_features, np.float64)
    own = np.asarray(point_features, np.float64) @ G.T
    derivative = _alpha_derivative(blend_, own, G.sum(axis=1), order(geometry_))
    return np.asarray(opacity, np.float64)[:, None] * derivative


def tracked(geometry_: Arrays, blend_: Arrays, max_tracked: int) -> np.ndarray:
    """(N, HW) bool: the max_tracked nearest used fragments of each pixel; 0: all of them."""
    return (
        blend_["fragment"] & (order(geometry_) < max_tracked) if max_tracked else blend_["fragment"]
    )


def _alpha_derivative(blend_, own, background, ranks):
    """(N, HW) dL/dalpha. own: G times each point's features. background: G times the background."""
    derivative = np.zeros_like(own)
    for q in np.flatnonzero(blend_["fragment"].any(axis=0)):
        points = np.flatnonzero(blend_["fragment"][:, q])
        rest = background[q]  # G times the colour composited behind a fragment
        for i in points[np.argsort(-ranks[points, q])]:
            if blend_["shows"][i, q]:
                derivative[i, q] = blend_["through"][i, q] * (own[i, q] - rest)
            rest += blend_["alpha"][i, q] * (own[i, q] - rest)
    return derivative


def sh_basis(directions: np.ndarray) -> np.ndarray:
    """(N, 9) real harmonics of degrees 0 to 2 for unit directions (N, 3), in cl/sh.h's order."""
    x, y, z = np.asarray(directions, np.float64).T
    first, second = np.sqrt(3 / (4 * np.pi)), np.sqrt(15 / (4 * np.pi))
    return np.stack(
        [
            np.full_like(x, 0.5 / np.sqrt(np.pi)),
            -first * y,
            first * z,
            -first * x,
            second * x * y,
            -second * y * z,
            np.sqrt(5 / (16 * np.pi)) * (3 * z * z - 1),
            -second * x * z,
            0.5 * second * (x * x - y * y),
        ],
        -1,
    )


def directions(positions: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """(N, 3) float64 unit vectors from the eye (3,) to positions (N, 3)."""
    towards = np.asarray(positions, np.float64) - eye
    return towards / np.linalg.norm(towards, axis=1, keepdims=True)


def opacities(positions: np.ndarray, eye: np.ndarray, learned: np.ndarray) -> np.ndarray:
    """(N,) float64 opacities seen from the eye. learned: PointCloud.opacity, (N, 9)."""
    return np.clip(unbounded_opacities(directions(positions, eye), learned), 0, 1)


def unbounded_opacities(towards: np.ndarray, learned: np.ndarray) -> np.ndarray:
    """(N,) float64 opacities in the unit directions (N, 3), not clipped. learned: (N, 9)."""
    return learned[:, 0] + (learned[:, 1:] * sh_basis(towards)[:, 1:]).sum(1)


def shade(positions: np.ndarray, eye: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """(N, C) features from coefficients (N, K, C), K = 1, 4 or 9."""
    basis = sh_basis(directions(positions, eye))
    return np.einsum("nk,nkc->nc", basis[:, : coefficients.shape[1]], coefficients)
