"""Pulsar's own renderer (PyTorch3D), where it is installed, on the scene of PulsarScene."""

import time

from pp_cl.bench.raster_scenes import CHANNELS, PulsarScene


def pulsar_row(n, size, gamma):
    """{"scene", "variant", "points", "size", "gamma", "forward_ms", "backward_ms"} of one run on
    the CPU.

    None where PyTorch3D is not installed.
    """
    try:
        import torch
        from pytorch3d.renderer.points.pulsar import Renderer
    except ImportError:
        return None
    torch.manual_seed(0)
    renderer = Renderer(size, size, n, n_channels=CHANNELS)
    positions = torch.rand(n, 3) + torch.tensor([-0.5, -0.5, 1.0])
    learned = [positions, torch.rand(n, CHANNELS), torch.full((n,), PulsarScene.radius)]
    for values in learned:
        values.requires_grad_(True)
    # at the origin, not turned; focal length, sensor
    camera = torch.tensor([0.0, 0, 0, 0, 0, 0, 0.5, 0.5])
    start = time.perf_counter()
    image = renderer(*learned, camera, gamma, PulsarScene.far, min_depth=PulsarScene.near)
    middle = time.perf_counter()
    image.backward(torch.randn_like(image))
    return {
        "scene": "pulsar",
        "variant": "pytorch3d",
        "points": n,
        "size": size,
        "gamma": gamma,
        "forward_ms": (middle - start) * 1e3,
        "backward_ms": (time.perf_counter() - middle) * 1e3,
    }
