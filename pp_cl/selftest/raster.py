"""Cases of the rasteriser before and after the blend weights: project, pairs, shade, depth."""

from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np

from pp_cl.engine.camera import Camera, look_at
from pp_cl.engine.device.buffers import Buffers
from pp_cl.engine.grid import Grid
from pp_cl.engine.raster.blend import shade_forward
from pp_cl.engine.raster.depth import depth_forward
from pp_cl.engine.raster.footprint import FOOTPRINTS
from pp_cl.engine.raster.highest_weights import record_weights
from pp_cl.engine.raster.points import OPACITIES, SH_DEGREES, sh_blocks
from pp_cl.engine.raster.project import TILE, project_grid
from pp_cl.engine.raster.weights import BLENDS
from pp_cl.reference import dense
from pp_cl.selftest.case import EPS, SIZES, Case, absolute, each, exact, finite, relative
from pp_cl.selftest.points import (
    AXIS,
    FAR,
    Blended,
    PairedGaussians,
    PairedPoints,
    blend_on_axis,
    make_camera,
    make_points,
    some_ids,
    some_opacities,
)

GRID = Grid((-1.1, -0.9, -0.7), 0.05, (45, 37, 29))
PLACED = 1e-6  # a rotated difference has 8 roundings of half EPS, and the camera two of its own
BAND = 1e-4  # pixels around the edge of a footprint in which rounding may decide
FALLOFF = 1e-4  # a falloff in that band, with a radius of at least 0.75 pixels
SUMMED = 1e-5  # a sum of up to 80 weights, half EPS each, divided by another sum
SHOWN = [0, 0, 3.0], [0.001, 0, 4.0]  # positions in front of the eye of AXIS


def _project(dev, rng):
    """Points in the cells of a grid; the depth range culls some. Points in the image cover a pixel,
    however small they are, and their places are compared.
    """
    camera = make_camera()
    for n in SIZES:
        ids = some_ids(rng, GRID, n)
        ids[-1] = GRID.ids(np.array(GRID.dims) - 1)
        offset = rng.uniform(-0.5, 0.5, (n, 4)).astype(np.float32)
        positions = GRID.positions(ids) + GRID.voxel_size * offset[:, :3]
        points = _projected(dev, "disc", camera, ids, offset, np.zeros((n, OPACITIES)), 0.01)
        place, covers = dense.camera_space(camera, positions), points.point_count.get() > 0
        beside = ~_inside(camera, place)
        x, y, z = place.T.astype(np.float32)
        column, row = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        off = np.hypot(*(u - np.floor(u) - np.float32(0.5) for u in (column, row)))
        naive = off * z < 0.01 * camera.fx  # a pixel's centre is within the disc
        yield exact(covers | beside, np.ones(n, bool), naive=naive | beside)
        least = dense.LEAST_RADIUS * np.linalg.norm(place, axis=1) / min(camera.fx, camera.fy)
        radius = 0.01 * np.exp(offset[:, 3])
        size = np.where(radius < least, -least, radius)
        found = _records(points)
        yield relative(found[covers, 4], size[covers], PLACED)
        yield relative(found[covers, :3], place[covers], PLACED)
        distance = np.linalg.norm(place[covers], axis=1)
        yield relative(found[covers, 3], distance, PLACED)

        positions, radius = make_points(rng, n), rng.uniform(0.01, 0.3, n)
        culled = PairedPoints(dev, camera, positions, radius, depth_range=(3.5, 4.8))
        covers = np.isin(np.arange(n), culled.seen)
        drawn = dense.drawn(camera, positions, radius, (3.5, 4.8))
        yield exact(covers[~drawn], np.zeros((~drawn).sum(), bool))
        place = dense.camera_space(camera, positions)
        yield exact(covers | ~(drawn & _inside(camera, place)), np.ones(n, bool))


def _records(points):
    """(N, 8) float32: x, y, z, distance, radius and opacity of points, and bits of their boxes."""
    return points.point_record.get()[:, :8].view(np.float32)


def _opacities(dev, rng):
    """Random opacities, and opacities seen along the axes, where harmonics exceed the bounds."""
    for n in SIZES:
        ids = some_ids(rng, GRID, n)
        yield from _check_opacities(dev, make_camera(), ids, some_opacities(rng, n))
    ids = GRID.ids(np.array([np.array(GRID.dims) // 2]))
    for axis, sign in product(np.eye(3), (-1, 1)):
        eye = GRID.positions(ids)[0] - 4 * sign * axis
        camera = replace(make_camera(), pose=look_at(eye, GRID.positions(ids)[0]))
        basis = dense.sh_basis(sign * axis[None])[0, 1:]
        for mean, along in product((0, 1e-7, 0.5, 1 - 1e-7, 1), (0, 1e-7, -1e-7, 0.5, -0.5, 1, -1)):
            learned = np.array([[mean, *(along * basis / (basis @ basis))]], np.float32)
            yield from _check_opacities(dev, camera, ids, learned)


def _check_opacities(dev, camera, ids, learned):
    points = _projected(dev, "soft", camera, ids, np.zeros((len(ids), 4)), learned, 0.05)
    covers = points.point_count.get() > 0
    expected = dense.opacities(GRID.positions(ids), camera.eye, learned)
    # eight products of about 1/2 with harmonics of a direction that has four roundings
    yield absolute(_records(points)[covers, 5], expected[covers], 8 * EPS)


def _far_away(dev, rng):
    """A scene a million units from the world's origin."""
    grid, ids = GRID.moved((1e6, -1e6, 1e6)).rounded(), some_ids(rng, GRID, 257)
    camera = make_camera().moved(grid.centre)
    yield from _check_places(dev, camera, grid, ids, grid.positions(ids).astype(np.float32))


def _many_vertices(dev, rng):
    """Points on a grid of 4 billion vertices."""
    grid = Grid((-1.0, -1.0, -1.0), 2 / 1600, (1600, 1600, 1600))
    ids = np.sort(rng.integers(grid.id_count, size=257)).astype(np.uint32)
    naive = grid.positions(ids.astype(np.float32)).astype(np.float32)
    yield from _check_places(dev, make_camera(), grid, ids, naive)


def _check_places(dev, camera, grid, ids, naive):
    """A check of the points' places in camera axes. naive: (N, 3) float32 world positions."""
    opacity, offset = np.zeros((len(ids), OPACITIES)), np.zeros((len(ids), 4))
    points = _projected(dev, "soft", camera, ids, offset, opacity, 0.01, grid)
    covers, pose = points.point_count.get() > 0, camera.pose.astype(np.float32)
    expected = dense.camera_space(camera, grid.positions(ids))[covers]
    naive = (naive[covers] - pose[:, 3]) @ pose[:, :3]
    yield relative(_records(points)[covers, :3], expected, PLACED, naive=naive)


def _projected(dev, footprint, camera, ids, offset, opacity, radius, grid=GRID):
    """The points of a grid, as projected by project_grid()."""
    return project_grid(
        dev,
        Buffers(dev),
        footprint,
        dev.upload(camera.packed(dense.DEPTH_RANGE, grid.centre)),
        dev.upload(grid.packed(grid.centre)),
        point_id=dev.upload(ids, np.uint32),
        cloud_offset=dev.upload(offset, np.float32),
        opacity=dev.upload(opacity, np.float32),
        radius=radius,
    )


def _inside(camera, place):
    """(N,) bool: whether points (N, 3) in the camera's axes lie in its image."""
    x, y, z = place.T
    column, row = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    inside = (column > 0) & (column < camera.width) & (row > 0) & (row < camera.height)
    return (z > 0) & inside


def _at_the_eye(dev, rng):
    """Points behind the eye, on its plane and at the eye cover no pixel."""
    positions = np.array([*SHOWN, [0, 0, -3.0], [0, 0, 0], [3.0, 0, 0], [0, 3.0, 1e-9]], np.float32)
    yield from _check_left_out(dev, positions, slopes=positions[:, 0] / positions[:, 2])


def _no_positions(dev, rng):
    """Points whose position is NaN, infinite or too far away cover no pixel."""
    positions = list(SHOWN)
    for bad in (np.nan, np.inf, -np.inf, 3e38, -3e38):
        positions += [[bad, 0, 3.0], [0, bad, 3.0], [0, 0, bad]]
    positions = np.array(positions, np.float32)
    distance = np.sqrt((positions**2).sum(1))
    yield from _check_left_out(dev, positions, shown=~((distance < 1e-3) | (distance > FAR)))


def _no_sizes(dev, rng):
    """Gaussians whose size is infinite or NaN cover no pixel."""
    grid, learned = Grid((0.0, 0.0, 0.0), 0.3, (2, 2, 2)), np.zeros((8, 16), np.float32)
    learned[2::3, 3], learned[1::3, 4] = np.inf, np.nan
    scene = PairedGaussians(dev, make_camera(), grid, some_ids(rng, grid, 8), learned, 0.1)
    radius = np.ceil(3 * np.sqrt(np.exp(2 * learned[:, 3:6]).sum(1)))
    yield exact(np.isin(np.arange(8), scene.seen), np.arange(8) % 3 == 0, naive=radius != 0)
    yield finite(scene.blend(np.ones(8), 0.1, np.ones((8, 16)), rule="alpha"))


def _check_left_out(dev, positions, *, shown=None, slopes=None):
    """Checks that only the first two points are shown. shown, slopes: naive formulas' (N,) bool and
    float32.
    """
    n, ones = len(positions), np.ones((1, 1, 16))
    for kind in FOOTPRINTS:
        scene = PairedPoints(dev, AXIS, positions, 0.01, kind=kind, depth_range=(1e-3, FAR))
        yield exact(np.isin(np.arange(n), scene.seen), np.arange(n) < 2, naive=shown)
        features = scene.blend(np.ones(n), 0.01, np.full((n, 16), 2))
        gradients = scene.gradients(ones)
        yield finite(features, *gradients.values(), naive=slopes)
        yield exact(
            [gradient[2:].any() for gradient in gradients.values()], [False] * len(gradients)
        )


def _pairs(kind, dev, rng):
    """The tiles of a point's box, the pixels that it covers, its falloff and depth there, and the
    order of points.
    """
    camera = replace(make_camera(33, 31), fy=26.0)
    for n in SIZES:
        positions, radius = make_points(rng, n), (10.0 ** rng.uniform(-3, 0, n)).astype(np.float32)
        scene = PairedPoints(dev, camera, positions, radius, kind=kind)
        naive = _by_squares(camera, positions, radius) if kind == "soft" else None
        yield from _check_pairs(scene, scene.exact(), naive)


def _by_squares(camera, positions, radius):
    """(N, HW) float32: falloffs, with a ray's distance from a centre as |c|^2 - (c.r)^2."""
    c, r = (
        array.astype(np.float32)
        for array in (dense.camera_space(camera, positions), dense.rays(camera))
    )
    range2, along = (c * c).sum(1)[:, None], c @ r.T
    rho2 = range2 - along * along
    width = np.sqrt(range2) / np.float32(min(camera.fx, camera.fy))
    reach = np.maximum(radius[:, None], np.float32(dense.LEAST_RADIUS) * width)
    return 1 - np.sqrt(rho2) / reach


def _check_pairs(scene, expected, naive):
    """Checks of pairs and fragments. naive: falloffs from a formula."""
    pairs, listed, fragments = scene.pairs, scene.listed, scene.fragments()
    clear, measured = expected["margin"] > BAND, scene.geometry()
    yield exact(fragments[clear], expected["fragment"][clear])
    beside = None if naive is None else naive[fragments]
    falloff = measured["falloff"][fragments], expected["falloff"][fragments]
    yield relative(*falloff, FALLOFF, naive=beside)
    yield relative(measured["depth"][fragments], expected["depth"][fragments], PLACED)
    counts = pairs.tile_offset.get().astype(np.int64)
    keys = pairs.pair_key.get()[: pairs.total]
    point, tile = keys & 0xFFFFFFFF, np.repeat(np.arange(len(counts) - 1), np.diff(counts))
    inner = tile[1:] == tile[:-1]
    yield exact((keys[1:] > keys[:-1])[inner], np.ones(inner.sum(), bool))
    of_points = np.bincount(point.astype(np.int64), minlength=scene.n)
    yield exact(of_points, scene.projected.point_count.get())
    yield exact(np.diff(pairs.point_offset.get().astype(np.int64)), of_points)
    # each fragment lies in a tile of its point
    y, x = np.divmod(listed.pixel, scene.shape[1])
    of_fragment = y // TILE * pairs.tiles[1] + x // TILE
    is_paired = np.zeros((scene.n, len(counts) - 1), bool)
    is_paired[point, tile] = True
    yield exact(is_paired[listed.point, of_fragment], np.ones(len(y), bool))
    inner = listed.pixel[1:] == listed.pixel[:-1]
    order = np.stack([scene.depths()[listed.point], listed.point.astype(np.float64)])
    later = (order[0, 1:] > order[0, :-1]) | (
        (order[0, 1:] == order[0, :-1]) & (order[1, 1:] > order[1, :-1])
    )
    yield exact(later[inner], np.ones(inner.sum(), bool))
    yield exact(scene.times_seen.get(), of_points > 0)


def _equal_depths(dev, rng):
    """Thousands of points at few depths in one tile, or all at one: a stable order."""
    camera = replace(AXIS, fx=30.0, fy=33.0)
    for n in (*SIZES, 10_000, 100_000):
        positions = np.zeros((n, 3))
        positions[:, 2] = np.round(rng.uniform(2.2, 5.9, n), 2) if n < 100_000 else 3
        pairs, z = PairedPoints(dev, camera, positions, 0.1).pairs, positions[:, 2]
        order = np.argsort(z.astype(np.float32), kind="stable")
        naive = np.argsort(z.astype(np.float32), kind="quicksort")
        yield exact(pairs.pair_key.get()[: pairs.total] & 0xFFFFFFFF, order, naive=naive)


def _close_depths(dev, rng):
    """Points each one float behind another, in random order."""
    positions = np.zeros((5000, 3), np.float32)
    positions[:, 2] = (
        np.float32(3).view(np.uint32) + rng.permutation(5000).astype(np.uint32)
    ).view(np.float32)
    scene = PairedPoints(dev, AXIS, positions, 0.1)
    depth, (near, far) = scene.depths(), scene.depth_range
    naive = np.argsort(((depth - near) / (far - near) * 65535).astype(np.uint16), kind="stable")
    order = scene.pairs.pair_key.get()[:5000] & 0xFFFFFFFF
    yield exact(order, np.argsort(depth, kind="stable"), naive=naive)


def _pixel_borders(dev, rng):
    """Points on the borders of pixels cover those on both sides."""
    camera = Camera(np.eye(3, 4), 32.0, 32.0, 0.0, 0.5, 33, 1)
    positions = np.zeros((32, 3))
    positions[:, 0], positions[:, 2] = np.arange(1, 33) / 8, 4
    scene = PairedPoints(dev, camera, positions, 1e-3, kind="disc")
    column = camera.fx * (positions[:, :1] / positions[:, 2:]).astype(np.float32)
    naive = np.rint(column - 0.5) == np.arange(33)
    expected = dense.geometry(camera, positions, 1e-3, "disc")["fragment"]
    yield exact(scene.fragments(), expected, naive=naive)


def _widest(dev, rng):
    """The widest image that is rendered, and the narrowest: where points are in them."""
    for width, focal in ((2**16 - 1, 30_000.0), (1, 1.0)):
        camera = Camera(np.eye(3, 4), focal, focal, width / 2, 0.5, width, 1)
        column = np.concatenate([[0, width - 1], rng.integers(width, size=62)]) + 0.5
        positions = np.zeros((64, 3), np.float32)
        positions[:, 2] = rng.uniform(2.2, 5.8, 64)
        positions[:, 0] = (column - camera.cx) / focal * positions[:, 2]
        scene = PairedPoints(dev, camera, positions, 1e-5, kind="disc", depth_range=(2.0, 9.0))
        expected, listed = np.floor(column), scene.listed
        in_centre = np.zeros(64, bool)
        in_centre[listed.point[listed.pixel == expected[listed.point]]] = True
        naive = expected.astype(np.uint16).view(np.int16) == expected
        yield exact(in_centre, np.ones(64, bool), naive=naive if width > 1 else None)


def _beside_the_eye(dev, rng):
    """Large points near the eye, beyond the image's border."""
    camera, n, depth_range = Camera(np.eye(3, 4), 26.0, 26.0, 16.0, 16.0, 33, 31), 64, (0.1, 6.0)
    positions = rng.uniform([-1.5, -1.5, 0.5], [1.5, 1.5, 1.0], (n, 3)).astype(np.float32)
    scene = PairedPoints(dev, camera, positions, 0.4, depth_range=depth_range)
    expected = dense.geometry(camera, positions, 0.4, "soft", depth_range=depth_range)
    clear, (x, y, z) = expected["margin"] > BAND, positions.T[..., None]
    row, column = np.indices((camera.height, camera.width), np.float32).reshape(2, -1) + 0.5
    off = [np.abs(26 * u / z + 16 - pixel) for u, pixel in ((x, column), (y, row))]
    naive = expected["fragment"] & (np.maximum(*off) <= 26 * np.float32(0.4) / z)
    yield exact(scene.fragments()[clear], expected["fragment"][clear], naive=naive[clear])


def _shade(dev, rng):
    """Harmonics of all degrees; features of Gaussians are at least 0. Only rows of listed points
    are written.
    """
    camera = make_camera()
    for n, degree in product(SIZES, SH_DEGREES):
        positions = make_points(rng, n)
        scene = PairedPoints(dev, camera, positions, 0.1)
        listed, sh = scene.seen[::2], [rng.normal(size=(n, b.count, 16)) for b in sh_blocks(degree)]

        def shade(sh, points=scene.projected, listed=listed):
            features = dev.upload(np.full((len(listed) + 3, 16), 7.0), np.float32)
            shade_forward(
                dev,
                points,
                dev.upload(listed, np.uint32),
                len(listed),
                [dev.upload(block) for block in sh],
                visible_features=features,
            )
            return features.get()

        features = shade([block.astype(np.float32) for block in sh])
        expected = dense.shade(positions, camera.eye, np.concatenate(sh, axis=1))
        # nine products of a direction's squares, with 5 roundings each, of values of up to 4
        yield relative(features[:-3], expected[listed], 1e-5)
        yield exact(features[-3:], np.full((3, 16), 7))
        record = dev.upload(np.pad(scene.projected.point_record.get(), ((0, 0), (0, 8))))
        gaussians = replace(scene.projected, footprint="gaussian", point_record=record)
        clamped = shade([block.astype(np.float32) for block in sh], gaussians)
        yield exact(clamped[:-3], np.maximum(features[:-3], 0))


def _depth(rule, dev, rng):
    """Alpha, and mean and median depth from the blend weights."""
    for n, kind in ((31, "soft"), (257, "soft"), (33, "disc")):
        blended = Blended(
            dev, rng, n, gamma=0.02, radius=0.4, rule=rule, early_stop=1e-2, kind=kind
        )
        scene = blended.scene
        alpha, depth, median = _depths(dev, scene)
        weight = scene.weight().astype(np.float64)
        z = dense.surface_depth(scene.camera, blended.geometry, blended.radius, kind)
        total = weight.sum(axis=0)
        covers = total > 0
        stopped = blended.dropped.any(axis=0) & (rule == "alpha")
        expected = np.where(stopped, 1, np.minimum(total, 1))
        beyond = blended.blend["background"] < 1e-2  # stopped, though nothing was dropped
        yield each(alpha[~beyond | stopped], expected[~beyond | stopped], SUMMED, floor=1e-2)
        yield exact(np.isinf(depth), ~covers)
        mean = (weight * z).sum(axis=0)[covers] / total[covers]
        yield relative(depth[covers], mean, SUMMED)
        yield exact(np.isinf(median), ~covers)
        low, high = _medians(blended, weight, z)
        yield absolute(median[covers], np.clip(median, low, high)[covers], SUMMED * z.max())


def _depth_of_nothing(dev, rng):
    nothing = np.zeros(1, np.float32)
    for rule in BLENDS:
        scene, _ = blend_on_axis(dev, [0.9, 0.5], [0.0, 0.0], 0.1, rule=rule)
        naive = np.concatenate([nothing, nothing / nothing, nothing / nothing])
        yield exact(np.concatenate(_depths(dev, scene)), [0, np.inf, np.inf], naive=naive)


def _depth_of_samples(dev, rng):
    """2 x 2 samples give the mean depth of those within a voxel of the nearest."""
    for n, kind, stop in ((257, "soft", 0.0), (257, "soft", 1e-2), (33, "disc", 0.0)):
        fine = Blended(dev, rng, n, radius=0.4, rule="alpha", early_stop=stop, kind=kind)
        scene = PairedPoints(
            dev, fine.camera, fine.positions, fine.radius, kind=kind, supersampling=2
        )
        scene.blend(fine.opacity, 0.1, fine.point_features, rule="alpha", early_stop=stop)
        alpha, *depths = (_fours(array, scene.shape) for array in _depths(dev, fine.scene))
        alpha_and_depths = _depths(dev, scene, 0.3)
        yield absolute(alpha_and_depths[0], alpha.mean(1), SUMMED + stop)
        for samples, depth in zip(depths, alpha_and_depths[1:], strict=True):
            near = samples <= samples.min(1, keepdims=True) + np.float32(0.3)
            is_far = np.isinf(samples.min(1))
            yield exact(np.isinf(depth), is_far)
            mean = np.where(near & ~is_far[:, None], samples, 0).sum(1) / near.sum(1)
            naive = samples.mean(1)[~is_far]
            yield relative(depth[~is_far], mean[~is_far], SUMMED, naive=naive)


def _fours(values, shape):
    """(H W, 4) samples of each pixel of an image (H, W), from (4 H W,)."""
    height, width = shape
    return values.reshape(height, 2, width, 2).swapaxes(1, 2).reshape(-1, 4)


def _medians(blended, weight, z):
    """Two (HW,) between which the medians lie, at shares just below and above one half."""
    fragments = blended.geometry["fragment"] & ~blended.dropped
    bounds = np.zeros((2, len(weight.T)))
    for q in np.flatnonzero(weight.any(axis=0)):
        order = np.argsort(blended.geometry["depth"][:, q], kind="stable")
        listed = order[fragments[order, q]]
        reached = np.concatenate([[0], np.cumsum(weight[listed, q])])
        depths = z[np.concatenate([listed[:1], listed]), q]  # the first fragment has no slope
        bounds[:, q] = np.interp(np.array([0.499999, 0.500001]) * reached[-1], reached, depths)
    return np.sort(bounds, axis=0)


def _depths(dev, scene, voxel_size=0.0):
    view = scene.projected, scene.pairs, scene.weights
    arrays = depth_forward(dev, *view, voxel_size)
    return [array.get().ravel() for array in arrays]


def _record(rule, dev, rng):
    """Each point's highest weight, also as the backward pass finds it, and how often it is seen."""
    blended = Blended(dev, rng, 500, gamma=0.02, radius=0.4, rule=rule, early_stop=0.05)
    before, times_seen = (dev.upload(x * np.arange(500), np.float32) for x in (2e-3, 1))
    highest, scene = before.copy(), blended.scene
    view = dev, scene.buffers, scene.projected, scene.pairs, scene.weights
    record_weights(*view, highest, times_seen)
    has_pairs = scene.projected.point_count.get() > 0
    yield exact(times_seen.get() - np.arange(500), has_pairs)
    weight = blended.blend["weight"].sum(axis=1)
    least = float(np.sort(weight)[-30:-28].mean())  # 29 points have a higher sum
    dev.fill(times_seen, 0)
    record_weights(*view, highest, times_seen, least)
    yield exact(times_seen.get(), weight > least)
    expected = np.maximum(2e-3 * np.arange(500), weight)
    yield relative(highest.get(), expected, PLACED)
    scene.gradients(blended.grad, max_weight=before)
    yield relative(before.get(), expected, PLACED)


BY_SQUARES = {"soft": "c.c - (c.r)^2 cancels"}
CASES = (
    Case("raster: project", _project, hard="only pixels whose centres it contains"),
    Case("raster: opacities by direction", _opacities),
    Case("raster: a scene moved by a million", _far_away, hard="world positions in float32"),
    Case("raster: ids of 4 billion vertices", _many_vertices, hard="ids stored as float32"),
    Case("raster: points at the eye", _at_the_eye, hard="x / z is 0 / 0"),
    Case("raster: sizes of NaN and infinity", _no_sizes, hard="radius == 0 culls none"),
    Case("raster: positions of NaN", _no_positions, hard="t < near or t > far culls none"),
    *(
        Case(f"raster: pairs, {kind}", partial(_pairs, kind), hard=BY_SQUARES.get(kind, ""))
        for kind in FOOTPRINTS
    ),
    Case("raster: points on pixel borders", _pixel_borders, hard="halves rounded to even"),
    Case("raster: an image of 65,535 columns", _widest, hard="columns of 16 bits with a sign"),
    Case("raster: large points beside the eye", _beside_the_eye, hard="a box of f R / z pixels"),
    Case("raster: thousands of equal depths", _equal_depths, hard="an unstable sort"),
    Case("raster: depths one float apart", _close_depths, hard="depths sorted in 16 bits"),
    Case("raster: shade", _shade),
    *(Case(f"raster: depth, {rule}", partial(_depth, rule)) for rule in BLENDS),
    Case("raster: depth of nothing", _depth_of_nothing, hard="divided by alpha, 0"),
    Case(
        "raster: depth of samples", _depth_of_samples, hard="the mean with an infinite background"
    ),
    *(Case(f"raster: highest weights, {rule}", partial(_record, rule)) for rule in BLENDS),
)
