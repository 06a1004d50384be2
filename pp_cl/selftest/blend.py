"""Cases of the two blends, alpha compositing and the softmax of Eq. (1): weights, features,
gradients, and where a naive formula overflows, divides by zero or hangs.
"""

from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np

from pp_cl.engine.device.buffers import Buffers
from pp_cl.engine.grid import Grid
from pp_cl.engine.layers.tiles import tiles_with
from pp_cl.engine.raster.footprint import FOOTPRINTS
from pp_cl.engine.raster.project import TILE
from pp_cl.engine.raster.weights import BLENDS
from pp_cl.engine.training.depth_loss import depth_gradient
from pp_cl.reference import dense
from pp_cl.reference.differences import numeric_gradient
from pp_cl.reference.loss import bending
from pp_cl.selftest.case import (
    SIZES,
    Case,
    absolute,
    allowed,
    each,
    exact,
    finite,
    relative,
)
from pp_cl.selftest.points import (
    AXIS,
    Blended,
    PairedGaussians,
    PairedPoints,
    blend_on_axis,
    make_camera,
    make_points,
    some_ids,
)

# alpha: a falloff has an error of 1e-6, like the projected places; a product of some ten 1 - alpha
# has ten times that. softmax: exponents o z / gamma of up to 100 have errors of 100 EPS
WEIGHT = {"alpha": 1e-5, "softmax": 2e-5}
GRADIENT = 2e-5  # alpha: T and the colour behind both have errors of WEIGHT
# softmax: dL/do = share (1 + o z / gamma) s, in which two factors have errors of WEIGHT
OPACITY = {"alpha": GRADIENT, "softmax": 5e-5}
RANGE = 2e-5  # 1 - T as a sum of weights: where a pixel hardly shows anything, T has few digits
DEPTH = 5e-5  # depths of 40 voxels round by 2e-6, in second differences four times
MANY = 1e-4  # a sum of 20000 terms, added one by one: each addition rounds the sum
UNIT = 2.0**-24  # rounding error of a float
ROUNDINGS = 4  # roundings of an exponent, and in a product of 16 terms
LEAST = 2.0**-126  # the smallest float that every device has
PLACE = 1e-5  # sums of some 30 pixels, with errors of GRADIENT / 2 in T and the colour behind
STEP = 1e-6
DIFFERENCES = 2e-3  # depth and falloff are steep at the rim, where the step is not small


def _forward(rule, kind, dev, rng):
    for gamma in (0.1, 0.01):
        blended = Blended(dev, rng, kind=kind, gamma=gamma, rule=rule)
        weights = blended.scene.weights
        yield absolute(blended.weight, blended.blend["weight"], WEIGHT[rule])
        expected = dense.features(blended.blend, blended.point_features)
        yield relative(blended.features, expected, WEIGHT[rule])
        empty = ~blended.geometry["fragment"].any(axis=0)
        yield exact(blended.features[empty], np.ones((empty.sum(), 16)))
        shows = blended.blend["fragment"] & blended.blend.get("shows", True)
        yield exact(weights.visible.get(), np.flatnonzero(shows.any(axis=1)))
        background = blended.blend["background"]
        yield absolute(weights.transmittance.get(), background, WEIGHT[rule])
        if rule == "alpha":
            ranges = np.where(shows, blended.geometry["depth"], 0)
            total = blended.blend["weight"].sum(axis=0)
            mean = (blended.blend["weight"] * ranges).sum(axis=0)[total > 0] / total[total > 0]
            yield relative(weights.mean_range.get()[total > 0], mean, RANGE)
            yield exact(weights.mean_range.get()[total == 0], np.zeros((total == 0).sum()))
        parts = shows.any(axis=0).reshape(blended.scene.shape)
        yield exact(weights.is_covered.get() != 0, tiles_with(parts))


def _backward(rule, kind, dev, rng):
    for gamma, tracked in ((0.1, 0), (0.01, 3 if rule == "softmax" else 0)):
        blended = Blended(dev, rng, kind=kind, gamma=gamma, max_tracked=tracked, rule=rule)
        gradients, expected = blended.gradients(), blended.reference_gradients(max_tracked=tracked)
        yield relative(gradients["features"], expected[0], GRADIENT)
        yield relative(gradients["opacity"], expected[1], OPACITY[rule])
        unseen = ~blended.geometry["fragment"].any(axis=1)
        yield exact(gradients["opacity"][unseen], np.zeros(unseen.sum()))


def _check_blended(blended):
    expected = dense.features(blended.blend, blended.point_features)
    yield relative(blended.features, expected, GRADIENT)
    gradients, references = blended.gradients(), blended.reference_gradients()
    yield relative(gradients["features"], references[0], GRADIENT)
    yield relative(gradients["opacity"], references[1], GRADIENT)


def _sizes(rule, dev, rng):
    for n, size in product(SIZES, ((1, 1), (31, 33))):
        yield from _check_blended(Blended(dev, rng, n, size=size, rule=rule))


def _early_stop(rule, dev, rng):
    """Fragments in front of the stop are kept, and all behind it are dropped."""
    for stop in (0.001, 0.05, 0.5):
        blended = Blended(dev, rng, 500, gamma=0.02, radius=0.4, rule=rule, early_stop=stop)
        fragment, used = blended.geometry["fragment"], blended.blend["fragment"]
        yield exact(blended.dropped, fragment & ~used)
        yield exact(blended.scene.weights.visible.get(), np.flatnonzero(used.any(axis=1)))
        yield from _check_blended(blended)


def _zero_opacity(rule, dev, rng):
    """The image is the background; every opacity has a gradient with which it can grow again."""
    for gamma, stop in ((0.1, 0.0), (0.01, 0.0), (1e-5, 0.0), (0.1, 1e-3)):
        scene, weight = blend_on_axis(
            dev, [0.9, 0.5, 0.2], [0.0] * 3, gamma, rule=rule, early_stop=stop
        )
        yield exact(weight, np.zeros(3))
        yield exact(scene.features.get(), np.ones((1, 1, 16)))
        gradients = scene.gradients(np.ones((1, 1, 16)))
        by_opacity = weight / np.zeros(3, np.float32)
        # d G.(f - bg), for a softmax exp(-M) / D with D = 1: a handful of roundings
        expected = scene.geometry()["falloff"][:, 0] * (1 - 16)
        if rule == "softmax":
            expected *= np.exp(-1e-6 / gamma)
        yield relative(gradients["opacity"], expected, 1e-5, naive=by_opacity)
        yield exact(gradients["features"], np.zeros((3, 16)))


def _on_the_ray(dev, rng):
    """A point in the middle of its pixel, which may move to any side."""
    scene = PairedPoints(dev, AXIS, np.array([[0, 0, 3.0]]), 0.2)
    scene.blend([0.5], 0.1, np.zeros((1, 16)), rule="alpha")
    gradient = scene.gradients(np.ones((1, 1, 16)), voxel_size=0.3)["offset"]
    away = np.zeros((1, 4), np.float32)
    yield absolute(gradient, away, 1e-2, naive=away / np.sqrt((away * away).sum()))


def _places(dev, rng):
    """Gradients of the places of points a thousand times as far away as they are large."""
    camera, n, radius, unit = make_camera(focal=3000.0), 257, 8e-3, 0.3
    positions = np.array([0.0, 0.1, 0.0]) + rng.normal(size=(n, 3)) * 0.01
    opacity, grad = rng.uniform(0, 0.3, n).astype(np.float32), rng.normal(size=(480, 16))
    features = rng.normal(size=(n, 16))
    scene = PairedPoints(dev, camera, positions.astype(np.float32), radius)
    scene.blend(opacity, 0.1, features, rule="alpha")
    gradients = scene.gradients(grad, voxel_size=unit)["offset"][:, :3]
    geometry = scene.geometry()
    dL_dd = dense.by_falloff(geometry, dense.alpha(geometry, opacity), opacity, features, grad)
    expected, naive = (
        _places_by(kind, scene, dL_dd, radius, unit) for kind in (np.float64, np.float32)
    )
    yield relative(gradients, expected, PLACE, naive=naive)


def _places_by(kind, scene, dL_dd, radius, unit):
    """(N, 3) gradients of places in a precision, with a ray's vector to a centre as c - (c.r) r."""
    camera = scene.camera
    c = scene.projected.point_record.get()[:, :3].view(np.float32).astype(kind)
    c[scene.projected.point_count.get() == 0] = 1  # undefined
    r = dense.rays(camera).astype(kind)
    away = c[:, None] - (c @ r.T)[..., None] * r[None]
    rho = np.linalg.norm(away, axis=2)
    by_place = (dL_dd.astype(kind) / np.where(rho > 0, rho * kind(radius), 1))[..., None] * -away
    return kind(unit) * by_place.sum(1) @ camera.pose[:, :3].T.astype(kind)


def _not_finite(dev, rng):
    """NaN and infinity in features, opacities and gradients reach the pixels and points that they
    concern, and no others but in the same blocks of 4 x 4 pixels.
    """
    n, ones = 257, np.ones((480, 16))
    blended = Blended(dev, rng, n, rule="alpha", radius=0.15)
    scene, features, opacity = blended.scene, blended.point_features, blended.opacity
    image, gradients = blended.features, blended.gradients()
    bad = int(np.argmax((blended.weight > 0).sum(1) % 40))  # covers some, but not all
    shown = scene.fragments()
    for value in (np.nan, np.inf, -np.inf):
        of_point = features.copy()
        of_point[bad] = value
        spoilt = scene.blend(opacity, 0.1, of_point, rule="alpha").reshape(-1, 16)
        blocks = _of_blocks(shown[bad], scene.shape)
        yield _none(np.isfinite(spoilt).any(1)[blended.weight[bad] > 0])
        naive = blended.weight.T @ of_point.astype(np.float32)  # 0 times NaN
        yield exact(spoilt[~blocks], image[~blocks], naive=naive[~blocks])
    scene.blend(opacity, 0.1, features, rule="alpha")
    pixel = int(np.argmax(blended.weight.sum(0) > 0.5))
    touches = shown[:, _of_blocks(np.arange(480) == pixel, scene.shape)].any(1)
    for value in (np.nan, np.inf, -np.inf):
        grad = blended.grad.copy()
        grad[pixel] = value
        spoilt = scene.gradients(grad)
        through = blended.weight[:, pixel] > 0
        yield _none(np.isfinite(spoilt["features"]).any(1)[through])
        for name, gradient in spoilt.items():
            yield exact(gradient[~touches], gradients[name][~touches])
        grad_alpha = np.zeros(480)
        grad_alpha[pixel] = value
        spoilt = scene.gradients(0 * ones, grad_alpha)["opacity"]
        yield _none(np.isfinite(spoilt[blended.weight[:, pixel] > 1e-3]))
        yield _none(~np.isfinite(spoilt[~touches]))


def _none(found):
    """A check that nothing is True."""
    return exact(found, np.zeros(found.shape, bool))


def _of_blocks(pixels, shape):
    """(HW,) bool: the blocks of 4 x 4 pixels of an image that hold any of these (HW,)."""
    tiles = tiles_with(pixels.reshape(shape)).repeat(4, 0).repeat(4, 1)
    return tiles[: shape[0], : shape[1]].ravel()


def _crowded(dev, rng):
    """An object that is a few pixels wide: all points in one tile."""
    camera, n = make_camera(24, 20, focal=4.0), 5000
    positions = make_points(rng, n) * 0.5
    opacity, features = rng.uniform(0, 0.02, n).astype(np.float32), rng.normal(size=(n, 16))
    scene = PairedPoints(dev, camera, positions, 0.3)
    image = scene.blend(opacity, 0.1, features, rule="alpha").reshape(-1, 16)
    geometry = scene.geometry()
    blend = dense.blend_by_rule("alpha", geometry, opacity, 0.1)
    nearest = np.argsort(scene.depths(), kind="stable")[:1024]
    few = (blend["weight"][nearest].T @ features[nearest]).astype(np.float32)
    few += 1 - blend["weight"][nearest].sum(0, dtype=np.float32)[:, None]
    yield relative(image, dense.features(blend, features), MANY, naive=few)
    grad = rng.normal(size=(480, 16))
    gradients = scene.gradients(grad)
    expected = dense.gradients(geometry, blend, features, grad)
    yield relative(gradients["features"], expected[0], MANY)
    yield relative(gradients["opacity"], expected[1], MANY)


def _offsets(dev, rng):
    """Gradients of offsets, compared with finite differences through the falloff."""
    camera, n, voxel_size = make_camera(), 40, 0.3
    positions, opacity = make_points(rng, n), rng.uniform(0, 1, n).astype(np.float32)
    features = rng.normal(size=(n, 16))
    grad = rng.normal(size=(camera.width * camera.height, 16))
    # a radius of 1e-3 gives the least size
    for radius, stop in ((0.4, 0.0), (0.4, 0.05), (1e-3, 0.0)):
        scene = PairedPoints(dev, camera, positions, radius)
        scene.blend(opacity, 0.1, features, rule="alpha", early_stop=stop)
        gradients = scene.gradients(grad, voxel_size=voxel_size)["offset"]
        exact_geometry = scene.geometry()
        used = dense.alpha(exact_geometry, opacity, stop)["fragment"]
        start = dense.geometry(camera, positions, radius, "soft")["falloff"]

        def loss(offset, i, radius=radius, exact_geometry=exact_geometry, used=used, start=start):
            place, wide = positions[i] + voxel_size * offset[:3], radius * np.exp(offset[3])
            falloff = start.copy()
            falloff[i] = dense.geometry(camera, place[None], wide, "soft")["falloff"][0]
            moved = exact_geometry | {"fragment": used, "falloff": falloff}
            return (dense.features(dense.alpha(moved, opacity), features) * grad).sum()

        numeric = [numeric_gradient(partial(loss, i=i), np.zeros(4), STEP) for i in range(n)]
        yield relative(gradients, np.array(numeric), DIFFERENCES)


def _gaussians(dev, rng):
    """Gaussians of all shapes: their images, and the gradients of positions and shapes, compared
    with finite differences; clamped features have no gradient. A radius of 1e-3 is far below a
    pixel.
    """
    shapes = (33, 0.1, 0.0), (17, 0.1, 0.05), (17, 1e-3, 0.0), (1, 0.2, 0.0)
    for shape, samples in product(shapes, (1.0, 3.5)):
        yield from _check_gaussians(dev, rng, *shape, samples)


def _check_gaussians(dev, rng, n, radius, stop, samples):
    camera = replace(make_camera(), samples=samples)
    grid = Grid((-1.5, -1.5, -1.5), 0.3, (11, 11, 11))
    ids = some_ids(rng, grid, n)
    learned = rng.uniform(-1, 1, (n, 9)).astype(np.float32)
    opacity = rng.uniform(0.1, 1, n).astype(np.float32)
    features = np.maximum(rng.normal(size=(n, 16)), 0)
    grad = rng.normal(size=(camera.width * camera.height, 16))
    scene = PairedGaussians(dev, camera, grid, ids, np.pad(learned, ((0, 0), (0, 7))), radius)
    image = scene.blend(opacity, 0.1, features, rule="alpha", early_stop=stop)
    gradients, measured = scene.gradients(grad, voxel_size=grid.voxel_size), scene.geometry()
    blend, fragment = dense.alpha(measured, opacity, stop), measured["fragment"]
    yield relative(image.reshape(-1, 16), dense.features(blend, features), WEIGHT["alpha"])
    expected = np.where(features > 0, blend["weight"] @ grad, 0)
    yield relative(gradients["features"], expected, WEIGHT["alpha"])
    vertices = grid.positions(ids)
    expected = dense.gaussians(camera, vertices, grid.voxel_size, learned, radius)["falloff"]
    yield absolute(measured["falloff"][fragment], expected[fragment], WEIGHT["alpha"])

    def loss(offset, i):
        moved = dense.gaussians(camera, vertices[i : i + 1], grid.voxel_size, offset[None], radius)
        falloff = expected.copy()
        falloff[i] = moved["falloff"][0]
        geometry = measured | {"fragment": blend["fragment"], "falloff": falloff}
        return (dense.features(dense.alpha(geometry, opacity), features) * grad).sum()

    rows = enumerate(learned)
    numeric = [numeric_gradient(partial(loss, i=i), offset, STEP) for i, offset in rows]
    yield relative(gradients["offset"][:, :9], np.array(numeric), DIFFERENCES)
    yield exact(gradients["offset"][:, 9:], np.zeros((n, 7)))


def _needles(dev, rng):
    """Gaussians across the image that are up to a million times as long as wide."""
    camera, grid = make_camera(), Grid((0.0, 0.0, 0.0), 0.3, (2, 2, 2))
    ids, learned = some_ids(rng, grid, 8), np.zeros((8, 16), np.float32)
    learned[:, 3:6] = -5
    learned[:, 6:8] = 10 ** rng.uniform(2, 4, (8, 1)) * rng.uniform(0.5, 1, (8, 2))
    scene = PairedGaussians(dev, camera, grid, ids, learned, 0.1)
    fragment, falloff = scene.fragments(), scene.geometry()["falloff"]
    vertices, shapes = grid.positions(ids), learned[:, :9]
    expected = dense.gaussians(camera, vertices, grid.voxel_size, shapes, 0.1)["falloff"]
    lower = np.zeros((8, 3, 3), np.float32)
    lower[:, range(3), range(3)] = 0.1 * np.exp(learned[:, 3:6])
    lower[:, [1, 2, 2], [0, 0, 1]] = 0.1 * learned[:, 6:9]
    naive = _by_determinant(camera, dense.camera_space(camera, vertices), lower)
    yield absolute(falloff[fragment], expected[fragment], WEIGHT["alpha"], naive=naive[fragment])


def _by_determinant(camera, centres, lower):
    """(N, HW) float32: falloffs of Gaussians, with the determinant computed as xx yy - xy^2.
    centres: (N, 3) in camera axes.
    """
    x, y, z = centres.astype(np.float32).T
    jacobian = np.zeros((len(x), 2, 3), np.float32)
    jacobian[:, 0, 0], jacobian[:, 0, 2] = camera.fx / z, -camera.fx * x / (z * z)
    jacobian[:, 1, 1], jacobian[:, 1, 2] = camera.fy / z, -camera.fy * y / (z * z)
    jacobian = jacobian @ camera.pose[:, :3].T.astype(np.float32)
    spread = jacobian @ (lower @ lower.swapaxes(1, 2)) @ jacobian.swapaxes(1, 2)
    xx, yy, xy = (spread[:, i, j, None] for i, j in ((0, 0), (1, 1), (0, 1)))
    xx, yy = xx + np.float32(dense.LOW_PASS), yy + np.float32(dense.LOW_PASS)
    row, column = np.indices((camera.height, camera.width), np.float32).reshape(2, -1) + 0.5
    u = column - (camera.fx * x / z + camera.cx)[:, None]
    v = row - (camera.fy * y / z + camera.cy)[:, None]
    return np.exp(-0.5 * (yy * u * u - 2 * xy * u * v + xx * v * v) / (xx * yy - xy * xy))


def _smallest_gamma(dev, rng):
    """gamma = 1e-5 makes exponents of 1e5, so that exponents and weights have errors of 1e-2."""
    for opacity in (1.0, 0.3, 1e-3, 1e-38):
        scene, weight = blend_on_axis(dev, [0.9, 0.8, 0.1], [opacity] * 3, 1e-5)
        yield finite(*scene.gradients(np.ones((1, 1, 16))).values())
        expected = dense.blend(scene.geometry(), np.full(3, opacity, np.float32), 1e-5)["weight"]
        yield each(weight, expected[:, 0], 1e-2, floor=1e-28, naive=_plain_softmax(scene, 1e-5))


def _plain_softmax(scene, gamma):
    """(N,) float32: a pixel's weights, computed without shifting the exponents."""
    view = scene.geometry()
    d, z, o = (
        array.astype(np.float32)
        for array in (view["falloff"][:, 0], view["z"][:, 0], scene.opacity)
    )
    share = o * d * np.exp(o * z / np.float32(gamma))
    return share / (np.exp(np.float32(dense.EPS / gamma)) + share.sum())


def _opacity_bound(blended):
    """(N,) bound of float32's error in dL/do (docs/maths.md): a product G.f rounds by the size of
    its terms, an exponent o z/gamma by 1/gamma, and a numerator below the smallest float becomes 0.
    """
    features, grad = blended.point_features, blended.grad
    blend, inverse = blended.blend, 1 / blended.gamma
    mean = dense.features(blend, features)
    size = np.abs(features) @ np.abs(grad).T + np.abs(mean * grad).sum(axis=1)
    dL_db = np.abs(features @ grad.T - (mean * grad).sum(axis=1))
    dL_db += (blend["weight"] * dL_db).sum(axis=0)  # an exponent's rounding moves the mean, too
    factor = 1 + blended.opacity[:, None] * np.abs(blend["z"]) * inverse
    rounded = blend["share"] * (size + (1 + inverse) * dL_db) * UNIT * ROUNDINGS
    underflow = LEAST * size
    return np.where(blend["fragment"], factor * (rounded + underflow), 0).sum(axis=1)


def _sharp(dev, rng):
    """If one fragment has nearly all the weight, dL/do is a rounded 0 times 1/gamma."""
    for kind, gamma in product(FOOTPRINTS, (1e-3, 1e-5)):
        blended = Blended(dev, rng, kind=kind, gamma=gamma)
        expected = blended.reference_gradients()[1]
        yield allowed(blended.gradients()["opacity"], expected, _opacity_bound(blended))


def _many_fragments(rule, dev, rng):
    """20000 fragments in a pixel: transmittance falls below the smallest number without NaN."""
    z, opacity = rng.uniform(0.1, 0.99, 20_000), rng.uniform(0, 1, 20_000).astype(np.float32)
    for gamma, stop in ((0.1, 0.0), (0.01, 1e-3 if rule == "alpha" else 0.0)):
        scene, weight = blend_on_axis(dev, z, opacity, gamma, rule=rule, early_stop=stop)
        geometry, features = scene.geometry(), np.resize(np.eye(16), (20_000, 16))
        blend = dense.blend_by_rule(rule, geometry, opacity, gamma, stop)
        naive = _plain_softmax(scene, gamma) if rule == "softmax" else None
        yield relative(weight, blend["weight"][:, 0], MANY, naive=naive)
        if rule == "alpha":  # down to 1e-30, some hundred factors of half EPS each
            yield each(weight, blend["weight"][:, 0], MANY, floor=1e-26)
        yield relative(scene.features.get().reshape(1, 16), dense.features(blend, features), MANY)
        grad = rng.normal(size=(1, 16))
        gradients = scene.gradients(grad)
        yield finite(*gradients.values())
        if rule == "alpha" and not stop:
            expected = dense.gradients(geometry, blend, features, grad)[1]
            naive = _divided(geometry, opacity, features @ grad[0], grad.sum())
            yield relative(gradients["opacity"], expected, MANY, naive=naive)


def _divided(geometry, opacity, own, background):
    """(N,) float32: a pixel's dL/do, computed from the back: the transmittance in front of a
    fragment is the one behind it divided by 1 - alpha. own, background: as in dense.gradients().
    """
    falloff, gradient = geometry["falloff"][:, 0].astype(np.float32), np.zeros(len(own), np.float32)
    alpha, own, behind = opacity * falloff, own.astype(np.float32), np.float32(background)
    T = np.prod(1 - alpha)
    for i in np.argsort(-geometry["depth"][:, 0], kind="stable"):
        T = T / (1 - alpha[i])
        gradient[i] = T * falloff[i] * (own[i] - behind)
        behind = behind + alpha[i] * (own[i] - behind)
    return gradient


def _opaque(dev, rng):
    """A fragment of alpha 1 between others, and many of them."""
    for opacity in (np.array([0.5, 1, 0.5], np.float32), np.ones(50, np.float32)):
        n, features = len(opacity), np.eye(16)[np.arange(len(opacity)) % 16]
        scene, _ = blend_on_axis(dev, np.linspace(0.9, 0.2, n), opacity, 0.1, rule="alpha")
        geometry, grad = scene.geometry(), rng.normal(size=(1, 16))
        blend = dense.blend_by_rule("alpha", geometry, opacity, 0.1)
        expected = dense.gradients(geometry, blend, features, grad)[1]
        naive = _divided(geometry, opacity, features @ grad[0], grad.sum())
        yield relative(scene.gradients(grad)["opacity"], expected, GRADIENT, naive=naive)


def _behind(dev, rng):
    """A hundred fragments, the last of which hardly show."""
    z, opacity = np.linspace(0.9, 0.1, 100), np.full(100, 0.15, np.float32)
    scene, weight = blend_on_axis(dev, z, opacity, 0.1, rule="alpha")
    geometry, grad, features = scene.geometry(), rng.normal(size=(1, 16)), np.eye(16)
    blend, features = dense.alpha(geometry, opacity), np.resize(features, (100, 16))
    own = features @ grad[0]
    expected = dense.gradients(geometry, blend, features, grad)[1]
    # the colour behind, as the total minus the colour in front
    b, single = weight.astype(np.float32), own.astype(np.float32)
    T = np.cumprod(np.append(np.float32(1), 1 - opacity), dtype=np.float32)
    parts = np.append(b * single, T[-1] * np.float32(grad.sum())).cumsum(dtype=np.float32)
    naive = T[:-1] * single - (parts[-1] - parts[:-1]) / (1 - opacity)
    most = GRADIENT * blend["through"][:, 0] * (np.abs(own).max() + np.abs(grad.sum()))
    yield allowed(scene.gradients(grad)["opacity"], expected, most, naive=naive)


def _far_distortion(dev, rng):
    """A hundred fragments within a tenth of a unit, a thousand units away."""
    positions, opacity = np.zeros((100, 3)), rng.uniform(0, 0.2, 100).astype(np.float32)
    positions[:, 2] = np.sort(rng.uniform(1000, 1000.1, 100))
    scene = PairedPoints(dev, AXIS, positions, 0.1, depth_range=(990.0, 1010.0))
    scene.blend(opacity, 0.1, np.zeros((100, 16)), rule="alpha")
    scene.gradients(np.zeros((1, 16)), distortion_weight=1.0)
    geometry = scene.geometry()
    expected = dense.distortion(geometry, dense.alpha(geometry, opacity))
    b = scene.weight()[:, 0]
    z = geometry["depth"][:, 0].astype(np.float32)
    front, front_z = b.cumsum(dtype=np.float32) - b, (b * z).cumsum(dtype=np.float32) - b * z
    naive = 2 * (b * (z * front - front_z)).sum(keepdims=True)
    yield relative(scene.backward.distortion.get(), expected, GRADIENT, naive=naive)


def _gradient_of_alpha(dev, rng):
    """The gradient of alpha equals that of a feature which is 0 in all points, since the background
    has 1.
    """
    for stop in (0.0, 0.05):
        blended = Blended(dev, rng, rule="alpha", early_stop=stop)
        grad_alpha = rng.normal(size=len(blended.grad))
        blended.point_features[:, 15] = 0
        features = blended.point_features
        blended.scene.blend(blended.opacity, 0.1, features, rule="alpha", early_stop=stop)
        blended.grad[:, 15] = -grad_alpha
        expected = blended.reference_gradients()
        blended.grad[:, 15] = 0
        gradients = blended.scene.gradients(blended.grad, grad_alpha)
        yield relative(gradients["opacity"], expected[1], GRADIENT)
        yield relative(gradients["features"][:, :15], expected[0][:, :15], GRADIENT)


def _distortion(dev, rng):
    """The distortion loss of all fragments, and of those before an early stop."""
    for n, stop in ((257, 0), (257, 0.05), (33, 0), (31, 0)):
        blended = Blended(dev, rng, n, rule="alpha", early_stop=stop)
        blended.grad[:] = 0
        expected = blended.reference_gradients(distortion_weight=3.0)[1]
        gradients = blended.gradients(distortion_weight=3.0)
        yield relative(gradients["opacity"], expected, GRADIENT)
        yield exact(gradients["features"], np.zeros((n, 16)))
        distortion = dense.distortion(blended.geometry, blended.blend)
        of_pixels = distortion.reshape(blended.scene.shape)
        rows = np.add.reduceat(of_pixels, range(0, len(of_pixels), TILE), 0)
        of_tiles = np.add.reduceat(rows, range(0, rows.shape[1], TILE), 1)
        yield relative(blended.scene.backward.distortion.get(), of_tiles.ravel(), GRADIENT)


def _depth_loss(dev, rng):
    """The depth loss of one and of 2 x 2 samples, before an early stop, too; some images are
    narrower than its strides.
    """
    sizes = (31, 33), (1, 20), (9, 1), (24, 20)
    for (size, n), stop in product(zip(sizes, (257, 31, 33, 600), strict=True), (0.0, 0.05)):
        for side in (1, 2):
            large = tuple(side * pixels for pixels in size)
            shared = {"rule": "alpha", "early_stop": stop}
            fine = Blended(dev, rng, n, radius=0.6, size=large, **shared)
            scene = PairedPoints(dev, fine.camera, fine.positions, fine.radius, supersampling=side)
            scene.blend(fine.opacity, 0.1, fine.point_features, **shared)
            view = scene.projected, scene.weights, scene.shape
            gradient = depth_gradient(dev, Buffers(dev), *view, voxel_size=0.1, weight=3.0)
            expected = _bent(fine, side, 0.1)
            yield relative(gradient.get()[:, 0], 3.0 * expected[:, 0], DEPTH)
            yield relative(gradient.get()[:, 1], expected[:, 1], DEPTH)
            expected[:, 0] *= 3.0 / side**2
            of_each = expected.reshape(*scene.shape, 2).repeat(side, 0).repeat(side, 1)
            fine.grad[:] = 0
            wanted = fine.reference_gradients(depth_gradient=of_each.reshape(-1, 2))[1]
            grad = np.zeros((*scene.shape, 16))
            gradients = scene.gradients(grad, depth_gradient=gradient)
            yield relative(gradients["opacity"], wanted, DEPTH)


def _samples(dev, rng):
    """2 x 2 samples give the mean of as many pixels; points cover all, some or none of them."""
    shapes = (257, None, 0.0), (257, None, 0.3), (33, 1e-3, 0.0), (31, 0.4, 0.05), (1, 0.4, 0.0)
    for kind, (n, radius, stop) in product(("soft", "disc"), shapes):
        of_samples = {"rule": "alpha", "early_stop": stop}
        fine = Blended(dev, rng, n, kind=kind, radius=radius, **of_samples)
        view = dev, fine.camera, fine.positions, fine.radius
        scene = PairedPoints(*view, kind=kind, supersampling=2)
        image = scene.blend(fine.opacity, 0.1, fine.point_features, **of_samples)
        expected = dense.features(fine.blend, fine.point_features)
        yield relative(image, _means(expected, scene.shape), WEIGHT["alpha"])
        rest = _means(fine.blend["background"][:, None], scene.shape)
        computed = scene.weights.transmittance.get().reshape(rest.shape)
        yield absolute(computed, rest, WEIGHT["alpha"])
        needed = fine.scene.weights.visible.get()
        yield exact(np.isin(needed, scene.weights.visible.get()), np.ones(len(needed), bool))
        grad = rng.normal(size=(*scene.shape, 16))
        fine.grad[:] = (grad / 4).repeat(2, 0).repeat(2, 1).reshape(-1, 16)
        gradients = scene.gradients(grad, distortion_weight=3.0)
        features, opacity = fine.reference_gradients(distortion_weight=3.0)
        yield relative(gradients["features"], features, GRADIENT)
        yield relative(gradients["opacity"], opacity, GRADIENT)
        distortion = dense.distortion(fine.geometry, fine.blend).sum()
        computed = scene.backward.distortion.get().sum()
        # a pixel with one fragment has only roundings of its distance from the tile's nearest point
        yield each(computed, distortion, GRADIENT, floor=1e-2)
        if kind == "soft":  # like the offsets of one sample, which _offsets() tests
            expected = fine.scene.gradients(fine.grad, voxel_size=0.3)["offset"]
            yield relative(scene.gradients(grad, voxel_size=0.3)["offset"], expected, GRADIENT)
        alpha = rng.normal(size=scene.shape)
        of_each = (alpha / 4).repeat(2, 0).repeat(2, 1).ravel()
        expected = fine.scene.gradients(0 * fine.grad, of_each)["opacity"]
        yield relative(scene.gradients(0 * grad, alpha.ravel())["opacity"], expected, GRADIENT)


def _bent(fine, side, voxel_size):
    """(HW, 2): depth_gradient() of a weight of 1; a pixel is side x side pixels of `fine`."""
    camera, weight = fine.camera, fine.blend["weight"]
    shape = camera.height // side, side, camera.width // side, side
    ranges = np.where(weight > 0, weight * fine.geometry["depth"], 0)
    alpha, sums = (array.sum(0).reshape(shape).mean((1, 3)) for array in (weight, ranges))
    has_surface = alpha >= 0.9
    alpha = np.where(has_surface, alpha, 1)
    mean = np.where(has_surface, sums / alpha, 0)
    y, x = side * (np.indices(mean.shape) + 0.5)
    axis = 1 / np.hypot(np.hypot((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy), 1)
    _, slope = bending(axis * mean / voxel_size, has_surface)
    return np.stack([(slope * axis / voxel_size / alpha).ravel(), mean.ravel()], 1)


def _means(samples, shape):
    """(H, W, C) means of 2 x 2 samples, (4 H W, C)."""
    height, width = shape
    return samples.reshape(height, 2, width, 2, -1).mean((1, 3))


def _of_both(what, function, **hard):
    """A case for each blend. hard: the naive formula's failure, by blend."""
    return [
        Case(f"{rule}: {what}", partial(function, rule), hard=hard.get(rule, "")) for rule in BLENDS
    ]


CASES = (
    *(
        Case(f"{rule}: {what}, {kind}", partial(function, rule, kind))
        for rule in BLENDS
        for what, function in (("forward", _forward), ("backward", _backward))
        for kind in FOOTPRINTS
    ),
    *_of_both("awkward sizes", _sizes),
    *_of_both("early stop", _early_stop),
    *_of_both(
        "opacities of 0",
        _zero_opacity,
        alpha="T d as b / o is 0 / 0",
        softmax="b (1/o + z/gamma) is 0 / 0",
    ),
    *_of_both(
        "20000 fragments in a pixel",
        _many_fragments,
        alpha="T / (1 - alpha) after an underflow",
        softmax="exp(o z / gamma) overflows",
    ),
    Case("softmax: gamma of 1e-5", _smallest_gamma, hard="exp(o z / gamma) overflows"),
    Case("softmax: dL/do at small gammas", _sharp),
    Case("alpha: an opaque fragment", _opaque, hard="T / (1 - alpha) is 0 / 0"),
    Case(
        "alpha: behind a hundred fragments",
        _behind,
        hard="all minus what is in front cancels",
    ),
    Case("alpha: gradient of alpha", _gradient_of_alpha),
    Case("alpha: distortion loss", _distortion),
    Case("alpha: depth loss", _depth_loss),
    Case("alpha: distortion far away", _far_distortion, hard="sums of b z from the eye cancel"),
    Case("alpha: a point on the ray", _on_the_ray, hard="e / length(e) is 0 / 0"),
    Case("alpha: offsets of points", _offsets),
    Case("alpha: places of far points", _places, hard="c - (c.r) r cancels"),
    Case("alpha: NaN and infinity", _not_finite, hard="0 times NaN"),
    Case("alpha: all points in one tile", _crowded, hard="at most 1,024 points of a tile"),
    Case("alpha: samples of a pixel", _samples),
    Case("alpha: shapes of Gaussians", _gaussians),
    Case("alpha: needles", _needles, hard="xx yy - xy^2 cancels"),
)
