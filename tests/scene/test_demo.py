import numpy as np
import pytest
import trimesh

from pp_cl.engine.camera import Camera
from pp_cl.reference.scene import distance
from pp_cl.scene.demo import OBJECT_BOX, SPLITS, demo_mesh, demo_views, render
from pp_cl.scene.hull import build_grid


def coverage(camera):
    """((H, W) share of a pixel's 4x4 rays that come within 4e-4 of the object, (H, W) share of
    those within 1e-5).
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


@pytest.mark.parametrize("width, height", ((31, 33), (33, 18)))
def test_silhouettes_equal_the_oracle(dev, width, height):
    """Alpha lies between the share of rays that touch the object and the share that comes within
    the tracer's tolerance of it.
    """
    camera = Camera.look_at((1.5, -2.8, 1.2), (0, 0, 0), fx=40, width=width, height=height)
    image = render(dev, camera)
    near, touching = coverage(camera)
    alpha = image[..., 3] / 255 * 16
    assert ((alpha < near * 16 + 0.5) & (alpha > touching * 16 - 0.5)).mean() > 0.995
    assert 0.1 < (alpha > 0).mean() < 0.9 and (near != touching).mean() < 0.05
    assert (image[image[..., 3] == 0] == 0).all()


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
    """There are 64 + 16 views. The mesh projects onto the masks, and their hull contains it."""
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
