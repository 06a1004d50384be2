from dataclasses import replace

import numpy as np
import pytest
from support.ball_views import CENTRE, RADIUS, ball_camera, ball_views
from support.launches import check_parts

from pp_cl.engine.camera import Camera
from pp_cl.engine.grid import Grid
from pp_cl.engine.views import MASK_THRESHOLD, View
from pp_cl.errors import UserError
from pp_cl.scene import hull
from pp_cl.scene.bounds import bounding_box
from pp_cl.scene.hull import Carver, build_grid, depth_range
from pp_cl.scene.load import load_scene


def positions_of(found):
    return found.grid.positions(found.ids)


def test_a_carving_in_parts_is_the_same(dev, rng, monkeypatch):
    views = []
    for eye in np.array([(3.0, 1, 0.5), (-2.0, 2, 1)]):
        alpha = np.where(rng.random((48, 64)) < 0.1, MASK_THRESHOLD + 1, MASK_THRESHOLD)
        image = alpha[..., None].repeat(4, -1).astype(np.uint8)
        views.append(View("noise", ball_camera(eye, np.zeros(3), (64, 48)), image))
    carver, grid = Carver(dev, views), Grid((-1, -1, -1), 2 / 40, (40, 13, 7))
    bits = []

    def carve():
        bits.append(carver.carve(grid))
        return bits[-1]

    assert check_parts(dev, monkeypatch, "carve", carve) == -(-13 * 7 // 4)
    assert bits[0].any()


def test_a_vertex_no_image_sees_is_dropped(dev):
    full = View(
        "full", ball_camera(np.array([4.0, 0, 0]), np.zeros(3)), np.full((64, 64, 4), 255, np.uint8)
    )
    carver = Carver(dev, [full])
    assert carver.carve(Grid((0, 0, 0), 0.1, (1, 1, 1))).all()
    assert not carver.carve(Grid((0, 9, 0), 0.1, (1, 1, 1))).any()  # beside what the camera sees
    assert not carver.carve(Grid((5, 0, 0), 0.1, (1, 1, 1))).any()  # behind the camera


def test_what_two_of_many_images_see_is_dropped(dev):
    here, there, vertex = np.zeros(3), np.array([9.0, 9, 9]), Grid((0, 0, 0), 0.1, (1, 1, 1))
    ahead = [(place, place + 4 * axis) for place in (here, there) for axis in np.eye(3)][1:]
    image = np.full((64, 64, 4), 255, np.uint8)
    image[0, 0] = 0  # without it there is no mask
    views = [View("full", ball_camera(eye, place), image) for place, eye in ahead]
    carver = Carver(dev, views)
    assert not carver.carve(vertex).any()
    assert carver.carve(vertex.moved(there)).all()


@pytest.mark.exact
def test_the_left_and_upper_borders_belong_to_an_image(dev):
    """float32 holds all numbers exactly: the 5x5 vertices project to pixels 0, 16, 32, 48, 64 of
    64.
    """
    camera = Camera(np.eye(3, 4), 64, 64, 32, 32, 64, 64)
    carver = Carver(dev, [View("full", camera, np.full((64, 64, 4), 255, np.uint8))])
    inside = carver.carve(Grid((-0.5, -0.5, 1.0), 0.25, (5, 5, 1)))
    assert inside[0, :4, :4].all() and inside.sum() == 16


@pytest.fixture
def carvings(monkeypatch):
    made, carve = [], Carver.carve

    def recorded(self, grid, forgiven=0):
        inside = carve(self, grid, forgiven)
        made.append((grid, inside.sum()))
        return inside

    monkeypatch.setattr(Carver, "carve", recorded)
    return made


@pytest.mark.large
@pytest.mark.parametrize("points", (1000, 3000, 40000))
def test_the_voxel_size_is_found(dev, points, carvings):
    built = build_grid(dev, ball_views(), points)
    assert points <= len(built.ids) <= hull.TOLERANCE * points and not built.capped
    assert carvings[-1][1] == len(built.ids) and len(carvings) <= 1 + hull.ROUNDS
    assert built.ids.dtype == np.uint32 and (np.diff(built.ids.astype(np.int64)) > 0).all()
    ids = built.grid.ids_of(np.ones(built.grid.dims[::-1], bool))
    lattice, in_hull = built.grid.positions(ids), np.isin(ids, built.ids)
    from_centre = np.linalg.norm(lattice - CENTRE, axis=1)
    assert in_hull[from_centre < RADIUS].all(), "a vertex inside the ball is lost"
    pixel = 4 / 96
    assert from_centre[in_hull].max() < 1.6 * RADIUS + 2 * pixel  # the hull is 12 tangent cones
    for axis in range(3):  # the grid is tight
        reached = positions_of(built)[:, axis]
        np.testing.assert_allclose(
            [reached.min(), reached.max()], [lattice[:, axis].min(), lattice[:, axis].max()]
        )


@pytest.mark.large
def test_the_cell_cap_limits_the_grid(dev, carvings, monkeypatch):
    """The ball fills about half of its box, so 8000 cells hold some 4000 of the 7000 requested
    points.
    """
    monkeypatch.setattr(hull, "CELL_CAP", 8000)
    built = build_grid(dev, ball_views(), 7000)
    assert built.capped and 3000 < len(built.ids) < 7000
    assert all(np.prod(grid.dims) <= 8000 for grid, _ in carvings[1:])


@pytest.mark.large
def test_masks_are_widened_by_a_pixel_of_the_reduced_images(dev):
    """Masks grow by three stored pixels on either side. A pixel's width on the object is the
    camera's distance divided by its focal length.
    """
    views = ball_views()
    grid = Grid.centred_in(CENTRE + 1.3 * RADIUS * np.array([[-1], [1]]), RADIUS / 60)
    whole, wide = (
        np.ptp(grid.positions(hull.hull_on(dev, v, grid)), axis=0)
        for v in (views, [view.reduced(4) for view in views])
    )
    camera = views[0].stored_camera
    pixel = np.linalg.norm(camera.eye - CENTRE) / camera.fx
    np.testing.assert_allclose(wide - whole, 2 * 3 * pixel, atol=pixel)


@pytest.mark.large
@pytest.mark.parametrize("focal", (2.7, 6.0))
def test_an_object_cut_off_by_the_images_keeps_what_they_show(dev, focal):
    """focal 2.7: the masks leave only the corners free; 6: only one pixel, so that no side of an
    image bounds the object.
    """
    views = ball_views(focal=focal)
    for view in views:
        view.image[0, 0] = 0
    box = bounding_box(views)
    assert np.isfinite(box).all() and (box[1] > box[0]).all()
    positions = positions_of(build_grid(dev, views, 3000))
    shown = CENTRE + 0.5 * min(RADIUS, 4 / (2 * focal)) * np.random.default_rng(1).uniform(
        -1, 1, (100, 3)
    )
    nearest = np.linalg.norm(positions[None] - shown[:, None], axis=-1).min(1)
    assert nearest.max() < 0.2 * RADIUS


def cropped(view):
    used = [np.flatnonzero((view.image[..., 3] > 0).any(axis)) for axis in (0, 1)]
    (x0, x1), (y0, y1) = ((int(u[0]), int(u[-1]) + 1) for u in used)
    camera = view.camera.crop(x0, y0, x1 - x0, y1 - y0)
    return replace(view, stored_camera=camera, image=view.image[y0:y1, x0:x1].copy())


def test_images_cropped_to_the_object_bound_it(dev):
    """Without Carver.doubts the hull would have ten times the volume."""
    views = ball_views(24, (200, 200))
    whole, tight = (build_grid(dev, v, 3000) for v in (views, [cropped(v) for v in views]))
    assert tight.grid.voxel_size**3 < 1.4 * whole.grid.voxel_size**3


@pytest.mark.parametrize("whole", (2, 3))
def test_close_ups_bound_the_object_only_where_no_image_shows_it_whole(dev, whole):
    """A vertex of the ball lies outside ten close-ups, whose masks hold only a corner pixel."""
    views = ball_views()
    image = np.zeros((8, 8, 4), np.uint8)
    image[0, 0] = 255
    near = replace(views[0], stored_camera=views[0].camera.crop(28, 28, 8, 8), image=image)
    vertex = CENTRE + 0.8 * RADIUS * views[0].camera.pose[:, 0]
    carver = Carver(dev, [*views[:whole], *[near] * 10])
    carver.least = 1
    assert carver.carve(Grid(tuple(vertex), 0.1, (1, 1, 1))).all() == (whole == 3)


@pytest.mark.large
@pytest.mark.parametrize("stated", [None, (1.0, 9.0), (3.9, 4.1)])
def test_depth_range_holds_every_point(dev, stated):
    views = [replace(view, depth_range=stated) for view in ball_views()]
    built = build_grid(dev, views, 2000)
    distances = [np.linalg.norm(positions_of(built) - v.camera.eye, axis=1) for v in views]
    near, far = depth_range(views, built)
    assert 0 < near < np.min(distances) and far > np.max(distances)
    half_diagonal = built.grid.voxel_size * np.linalg.norm(built.grid.dims) / 2
    if stated is None:
        assert far - near == pytest.approx(2 * hull.DEPTH_MARGIN * half_diagonal, rel=0.05)
    if stated == (1.0, 9.0):
        assert (near, far) == stated


@pytest.mark.large
@pytest.mark.parametrize("distance", (1.6, 0.5))
def test_depth_range_of_close_cameras(dev, distance):
    """1.6 is outside the hull's box, but inside the enlarged ball; 0.5 is inside the box."""
    built = build_grid(dev, ball_views(), 2000)
    camera = ball_camera(CENTRE + np.array([distance, 0, 0]), CENTRE)
    near, far = depth_range([replace(ball_views()[0], stored_camera=camera)], built)
    distances = np.linalg.norm(positions_of(built) - camera.eye, axis=1)
    assert near > 0 and far > distances.max()
    assert near < distances.min() if distance > 1 else near == built.grid.voxel_size


@pytest.mark.large
def test_a_box_that_is_stated_bounds_what_the_masks_allow(dev):
    box = np.stack([CENTRE, CENTRE + [3, 0.4, 3]])
    built = build_grid(dev, ball_views(), 2000, box)
    assert (built.grid.box[0] > box[0] - 2 * built.grid.voxel_size).all()
    assert (built.grid.box[1] < CENTRE + [1.6, 0.4 + 2 * built.grid.voxel_size, 1.6]).all()


@pytest.mark.large
def test_an_eye_in_the_middle_hides_no_view():
    views = ball_views()
    views[2] = replace(views[2], stored_camera=replace(views[2].stored_camera, pose=np.eye(3, 4)))
    order = hull._farthest_point_order(views, np.zeros(3))
    assert sorted(map(id, order)) == sorted(map(id, views))


def test_without_masks_a_box_that_is_stated_is_filled(dev):
    views = [replace(view, image=np.full_like(view.image, 255)) for view in ball_views()]
    box = np.stack([CENTRE - 0.5, CENTRE + 0.5])
    np.testing.assert_allclose(build_grid(dev, views, 2000, box).grid.box, box, atol=0.1)


@pytest.mark.parametrize("points", (0, -3, 2**27 + 1))
def test_impossible_counts(dev, points):
    with pytest.raises(UserError, match="--points .*between 1 and"):
        build_grid(dev, ball_views(), points)


def test_lego_has_the_published_shape(dev, data):
    """In the supplemental (PlenopticPoints, Table 4) the grid of 4.04 million points has
    194x345x232 vertices.
    """
    views = load_scene(data / "nerf_synthetic/lego").splits["train"]
    built = build_grid(dev, views, 20000)
    assert 20000 <= len(built.ids) <= hull.TOLERANCE * 20000
    edges = np.array(built.grid.dims) / (np.array([194, 345, 232]) * (20000 / 4e6) ** (1 / 3))
    assert np.abs(edges - 1).max() < 0.06
    assert depth_range(views, built) == pytest.approx((2, 6), abs=0.15)
