"""Every driver of kernels, run once in each form that it has on a GPU, on tiny inputs.

What they compute is of no interest: tools/gpu/builds.py notes which programs they build.
"""

import math
from dataclasses import replace
from itertools import product

import numpy as np

from pp_cl.bench.conv import RandomConv
from pp_cl.bench.peak import CopyBandwidth, PeakFlops
from pp_cl.bench.raster_scenes import SCENES
from pp_cl.bench.unet import make_network, train_runner
from pp_cl.config import Config, assign, preset
from pp_cl.device.device import Device
from pp_cl.layers.choice import CHOICES, device_class, make_policy, offered
from pp_cl.layers.conv import Direction
from pp_cl.layers.tiles import tiles_find
from pp_cl.metrics.lpips import Lpips, vgg_layers
from pp_cl.metrics.shape import Mesh, sample_surface
from pp_cl.model import Model
from pp_cl.network.layers import BLOCKS
from pp_cl.network.unet import LEAST_PIXELS, UNet
from pp_cl.presets import PRESETS
from pp_cl.raster.blend import BLENDS
from pp_cl.raster.project import KINDS
from pp_cl.raster.sh import SH_DEGREES
from pp_cl.raster.shade import shade_forward
from pp_cl.render import Renderer
from pp_cl.scene import demo
from pp_cl.scene.grid import Grid
from pp_cl.scene.hull import build_grid, depth_range
from pp_cl.scene.views import View
from pp_cl.settings import RasterConfig
from pp_cl.train import Trainer
from pp_cl.training.perceptual import PerceptualLoss

GAMMA = 0.05
CHANNELS = 16
SPARSE_SIZE = math.isqrt(LEAST_PIXELS)  # of an image whose background tiles are skipped
VGG_WIDTHS = (CHANNELS,) * 5
# Everything that a training does is due within its few steps; widths and sizes are small.
TRAINING = {
    "points.count": 400,
    "network.widths": (CHANNELS,) * 3,
    "train.iterations": 9,
    "train.crop": 32,
    "train.sh_delay": (0.0, 0.0, 0.0),
    "train.sh_smoothing": 0.03,
    "train.sh_smoothing_every": 2,
    "train.prune_every": 3,
    "train.prune_looks": 1,
    "train.final_prune_weight": 0.01,
    "train.ema": True,
}
# What the presets leave out, beside them.
MORE_TRAININGS = ({"train.refine_at": (0.4, 1.0), "raster.blend": "softmax"},)
# Hits that a blending passes over: none, those behind an early stop, those beyond the nearest.
DROPPING = (
    {"early_stop": 0.0},
    {"early_stop": 0.001},
    {"early_stop": 0.0, "max_tracked": PRESETS["paper"]["raster.max_tracked"]},
    {"early_stop": 0.001, "max_tracked": PRESETS["paper"]["raster.max_tracked"]},
)


def run_all(dev: Device) -> None:
    """Run every driver on a device."""
    views = demo.demo_scene(dev, ("train",), 64, most=6).splits["train"]
    trainings(dev, views)
    blends(dev, views)
    shadings(dev, views)
    benchmarks(dev)
    convolutions(dev)
    networks(dev)
    perceptual(dev)
    shapes(dev)


def trainings(dev: Device, views: list[View]) -> None:
    """A training by every preset, and by those of MORE_TRAININGS."""
    for name, more in [*((name, {}) for name in PRESETS), *(("tiny", m) for m in MORE_TRAININGS)]:
        config = preset(name)
        for key, value in (TRAINING | more).items():
            assign(config, key, value, "gpu_check")
        trainer = Trainer(dev, config, _model(dev, config, views), views)
        for _ in range(config.train.iterations):
            trainer.train_step()
        trainer.finish()
        trainer.render(views[0])


def _model(dev, config, views):
    hull = build_grid(dev, views, config.points.count)
    net = UNet.of_settings(dev, config.network, seed=0, policy=make_policy(dev))
    near_far = depth_range(views, hull)
    return Model.create(dev, hull.grid, hull.ids, near_far, net=net, degree=config.points.sh_degree)


def blends(dev: Device, views: list[View]) -> None:
    """Every blend of every footprint, forward and backward, with alpha and depth."""
    config, camera = preset("tiny"), views[0].camera
    assign(config, "points.count", 400, "gpu_check")
    model = _model(dev, config, views)
    grad_alpha = dev.zeros((camera.height * camera.width,))
    for footprint, blend, mean, dropping in product(KINDS, BLENDS, (False, True), DROPPING):
        settings = RasterConfig(
            footprint=footprint, blend=blend, mean_gradient=mean, radius=0.01, **dropping
        )
        renderer = Renderer(dev, model, settings)
        for grad in (None, grad_alpha) if blend == "alpha" else (None,):
            result = renderer.rasterise(camera, GAMMA)
            renderer.backward_features(result, dev.zeros(result.features.shape), grad)
        renderer.picture(camera, GAMMA)
    scene = SCENES["pulsar"](dev, 60, 16, GAMMA)
    for blend in BLENDS:
        scene.backward(blend, scene.forward(blend))


def shadings(dev: Device, views: list[View]) -> None:
    """Harmonics of every degree, in 32 and 16 bits."""
    for degree in SH_DEGREES:
        config = Config()
        assign(config, "points.sh_degree", degree, "gpu_check")
        assign(config, "points.count", 400, "gpu_check")
        renderer = Renderer(dev, _model(dev, config, views), config.raster)
        result = renderer.rasterise(views[0].camera, GAMMA)
        half = [dev.upload(sh.get(), np.float16) for sh in renderer.model.cloud.sh]
        shade_forward(dev, result.points, result.shaded, half, point_features=result.point_features)


def benchmarks(dev: Device) -> None:
    """The measured peaks."""
    PeakFlops(dev)
    CopyBandwidth(dev).run()


def convolutions(dev: Device) -> None:
    """All directions and sizes of kernels, with every blocking that `pp-cl tune` tries; with
    channels of every parity and in groups of 16, 32 and 64.
    """
    policy = make_policy(dev)
    tried = [
        replace(policy.blocking, **{name: value})
        for name, values in CHOICES[device_class(dev)].items()
        for value in values
    ]
    for k, (side, channels) in product((1, 3), ((8, 16), (8, 32), (8, 64), (8, 6), (8, 5), (2, 5))):
        conv = RandomConv(dev, k, side, (channels,), co=channels)
        for blocking, direction in product([policy.blocking, *tried], Direction):
            for variant in conv.variants:
                conv.runner(variant, direction, replace(policy, blocking=blocking))()


def networks(dev: Device) -> None:
    """Networks of all blocks, and one that skips background tiles."""
    for blocks, size, variant in product(BLOCKS, (4, 16), offered(device_class(dev))):
        net = make_network(dev, (CHANNELS,) * 3, make_policy(dev, variant=variant), blocks)
        x, grad = dev.zeros((size, size, CHANNELS)), dev.zeros((size, size, 3))
        train_runner(dev, net, x, grad)()
    size = SPARSE_SIZE, SPARSE_SIZE
    x, grad = dev.zeros((*size, CHANNELS)), dev.zeros((*size, 3))
    active = tiles_find(dev, x, 0.0).get()
    active[:2, :2] = True
    net.forward(x, plan=net.plan_tiles(size, active))
    net.backward(grad)


def perceptual(dev: Device) -> None:
    """LPIPS, as metric and as loss, of a network of VGG16's shape."""
    weights = {f"head{i}": np.ones(w, np.float32) for i, w in enumerate(VGG_WIDTHS)}
    for i, layer in enumerate(vgg_layers(VGG_WIDTHS)):
        weights[f"kernel{i}"] = np.ones((layer.co, layer.ci, 3, 3), np.float32)
        weights[f"bias{i}"] = np.zeros(layer.co, np.float32)
    image = np.random.default_rng(0).random((32, 32, 3), np.float32)
    Lpips(dev, weights).distance(image, 1 - image)
    loss = PerceptualLoss(dev, 1.0, make_policy(dev), weights)
    loss.add(
        dev.upload(image),
        dev.upload(1 - image),
        (0, 0),
        grad_prediction=dev.zeros(image.shape),
        terms=dev.zeros((4,)),
    )


def shapes(dev: Device) -> None:
    """The demo's mesh and the surface of a mesh."""
    grid = Grid((-0.5, -0.5, -0.5), 0.2, (6, 6, 6))
    demo.distances(dev, grid)
    sample_surface(dev, Mesh(np.eye(3), np.array([[0, 1, 2]])), grid, 64)
