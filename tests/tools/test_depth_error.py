import numpy as np
import pytest
import trimesh

from pp_cl.scene.demo import demo_frames, demo_mesh
from tools.depth_error import DemoSurface

pytestmark = pytest.mark.slow


def test_the_depth_is_where_rays_meet_the_mesh(dev, rng):
    camera = demo_frames("test", 48)[3].camera
    depth = DemoSurface(dev).depth(camera)
    vertices, faces = demo_mesh(dev, 256)
    rays = camera.rays()
    chosen = [tuple(p) for p in rng.integers(0, 48, (60, 2))]
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    directions = np.array([rays[p] for p in chosen])
    places, index, _ = mesh.ray.intersects_location(
        np.tile(camera.eye, (len(chosen), 1)), directions, multiple_hits=False
    )
    exact = np.full(len(chosen), np.inf)
    exact[index] = (places - camera.eye) @ camera.pose[:, 2]
    found = np.array([depth[p] for p in chosen])
    agree = np.isfinite(exact) == np.isfinite(found)
    assert agree.mean() > 0.95 and np.isfinite(exact).sum() > 5
    both = np.isfinite(exact) & np.isfinite(found)
    assert np.median(np.abs(exact[both] - found[both])) < 0.004  # the mesh's edge is 0.0075
