"""The demo's object and images: distances and silhouettes against the float64 oracle, mesh,
gloss, the written folder.
"""

import numpy as np
import pytest
import trimesh

from pp_cl.engine.camera import Camera
from pp_cl.engine.grid import Grid
from pp_cl.reference.scene import CENTRE, distance
from pp_cl.scene.demo import OBJECT_BOX, SPLITS, demo_mesh, demo_views, distances, render
from pp_cl.scene.hull import build_grid

KEY = np.array([0.40, -0.52, 0.7547])  # direction of the key light


def coverage(camera):
    """((H, W) share of 4x4 rays a pixel that come within 4e-4 of the object, (H, W) the same for
    1e-5).
    """
    sub = (np.arange(4) + 0.5) / 4
    x = (np.arange(camera.width)[:, None] + sub).ravel()
    y = (np.arange(camera.height)[:, None] + sub).ravel()
    x, y = np.meshgrid((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy)
    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True) @ camera.pose[:, :3].T
    t, closest = np.full(len(rays), 1.0), np.full(len(rays), np.inf)
    marching = np.arange(len(rays))
    for _ in range(400):
        d = distance(camera.eye + t[marching, None] * rays[marching])
        closest[marching] = np.minimum(closest[marching], d)
        t[marching] += d
        marching = marching[(d > 1e-5) & (t[marching] < 8)]
    tiles = closest.reshape(camera.height, 4, camera.width, 4)
    return (tiles < 4e-4).mean((1, 3)), (tiles <= 1e-5).mean((1, 3))


def test_distances_change_no_faster_than_places(dev):
    """Sphere tracing passes no surface."""
    grid = Grid((-0.8, -0.8, -1.1), 0.05, (33, 33, 45))
    for axis in range(3):
        assert np.abs(np.diff(distances(dev, grid), axis=axis)).max() <= 0.05 * (1 + 1e-4)


@pytest.mark.parametrize("width, height", ((31, 33), (33, 18)))
def test_silhouettes_equal_the_oracle(dev, width, height):
    """Alpha lies between the shares of the rays that touch and of those that come within the
    tracer's tolerance.
    """
    camera = Camera.look_at((1.5, -2.8, 1.2), (0, 0, 0), fx=40, width=width, height=height)
    image = render(dev, camera)
    near, touching = coverage(camera)
    alpha = image[..., 3] / 255 * 16
    assert ((alpha < near * 16 + 0.5) & (alpha > touching * 16 - 0.5)).mean() > 0.995
    assert 0.1 < (alpha > 0).mean() < 0.9 and (near != touching).mean() < 0.05
    assert (image[image[..., 3] == 0] == 0).all()


@pytest.mark.large
def test_a_crop_shows_the_same_pixels(dev):
    camera = Camera.look_at((-2.0, 2.0, 1.5), (0, 0, 0), fx=80, width=64, height=64)
    whole, part = render(dev, camera), render(dev, camera.crop(13, 21, 33, 29))
    # rays that graze an edge may choose otherwise
    differing = (np.abs(whole[21:50, 13:46].astype(int) - part) > 1).any(-1)
    assert differing.mean() < 0.01 and (part[..., 3] > 0).mean() > 0.3
    np.testing.assert_array_equal(render(dev, camera), whole)


def test_the_globe_is_glossy(dev):
    """The place that faces the key light is brighter where it mirrors the lamp to the camera than
    from the side.
    """
    facing = CENTRE + 0.30 * KEY
    side = np.cross(KEY, [0, 0, 1.0])
    colours = []
    for eye in (KEY, KEY + side, KEY - side):
        eye = CENTRE + 0.2 * KEY + 0.4 * eye / np.linalg.norm(eye)
        image = render(dev, Camera.look_at(eye, facing, fx=2000, width=3, height=3))
        assert (image[..., 3] == 255).all()
        colours.append(image[1, 1, :3] / 255)
    mirrored, *others = colours
    for other in others:
        assert (mirrored - other > 0.05).all()


@pytest.mark.large
def test_the_mesh_is_the_object(dev):
    vertices, faces = demo_mesh(dev, 192)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight and mesh.body_count == 1 and mesh.volume > 0.25
    assert mesh.euler_number < -20, "rings and spokes enclose holes"
    voxel_size = 1.92 / 191
    assert np.abs(distance(vertices.astype(np.float64))).max() < voxel_size / 2
    assert (vertices.min(0) > OBJECT_BOX[0]).all() and (vertices.max(0) < OBJECT_BOX[1]).all()
    assert np.linalg.norm(vertices - [0, 0, -0.08], axis=1).max() < 1.05, (
        "the tracer's ball cuts the object"
    )


@pytest.mark.large
def test_the_scene_shows_the_whole_mesh(dev):
    """64 + 16 views; the mesh projects onto the masks, which carve a hull that holds it."""
    train, test = (demo_views(dev, split, size=64) for split in SPLITS)
    assert (len(train), len(test)) == (64, 16)
    vertices, _ = demo_mesh(dev, 64)
    eyes = []
    for view in train + test:
        camera, alpha = view.camera, np.pad(view.image[..., 3], 1)
        np.testing.assert_allclose(camera.pose[:, :3].T @ camera.pose[:, :3], np.eye(3), atol=1e-12)
        assert np.linalg.det(camera.pose[:, :3]) > 0 and view.depth_range is None
        assert not alpha[[1, -2]].any() and not alpha[:, [1, -2]].any(), (
            f"{view.name} cuts the object off"
        )
        u, v, _ = camera.project(vertices).astype(int) + 1
        around = np.max([alpha[v + dv, u + du] for dv in (-1, 0, 1) for du in (-1, 0, 1)], axis=0)
        assert (around > 0).all()
        eyes.append(camera.eye)
    gaps = np.linalg.norm(np.array(eyes)[:, None] - eyes, axis=-1) + 9 * np.eye(80)
    assert gaps.min() > 0.1, "two views are nearly the same"

    hull = build_grid(dev, train, 20000)
    ids = hull.grid.ids_of(np.ones(hull.grid.dims[::-1], bool))
    inside = distance(hull.grid.positions(ids)) < 0
    in_hull = np.isin(ids, hull.ids)
    assert inside.sum() > 2000 and in_hull[inside].all()
