from dataclasses import replace

import numpy as np
import pytest
from support.comparisons import relative_error
from support.models import GRID, make_model
from support.scenes import ring_cameras

from pp_cl.bench.unet import plain_parameters
from pp_cl.engine.raster.weights import BLENDS
from pp_cl.engine.render import Renderer
from pp_cl.errors import UserError
from pp_cl.reference import dense as oracle_raster
from pp_cl.reference.network import network, network_gradients
from pp_cl.settings import RasterConfig

GAMMA = 0.03


def chained(model, settings, camera, k=1):
    """Float64 rendering by the padded camera, k x k drawn pixels for each: (image, function from
    its gradient to those of the points' features, their opacities and the network).
    """
    padded, _, _ = camera.padded(4)
    shape, padded = (padded.height, padded.width), padded.enlarged(k)
    positions = GRID.positions(model.cloud.ids.get())
    opacity = oracle_raster.opacities(positions, padded.eye, model.cloud.opacity.get())
    sh = np.concatenate([array.get() for array in model.cloud.sh], 1)
    unit = GRID.voxel_size if settings.footprint == "soft" else np.ptp(model.depth_range) / 4
    geometry = oracle_raster.geometry(padded, positions, settings.radius * unit, settings.footprint)
    blend = oracle_raster.blend_by_rule(
        settings.blend, geometry, opacity, GAMMA, settings.early_stop
    )
    point_features = oracle_raster.shade(positions, padded.eye, sh)
    features = oracle_raster.features(blend, point_features)
    parameters = plain_parameters(model.net, model.net.parameters)
    layers = model.net.layers
    features = features.reshape(shape[0], k, shape[1], k, 16).mean((1, 3))
    outputs = network(layers, parameters, features)
    active = {name: values > 0 for name, values in outputs.items()}

    def backward(grad_image):
        grad_net = network_gradients(layers, parameters, outputs, active, grad_image=grad_image)
        grad_features = (grad_net.pop("x") / k**2).repeat(k, 0).repeat(k, 1).reshape(-1, 16)
        tracked = settings.max_tracked if settings.blend == "softmax" else 0
        of_points = oracle_raster.gradients(
            geometry, blend, point_features, grad_features, max_tracked=tracked
        )
        return *of_points, grad_net

    return outputs["image"], backward


SETTINGS = {
    "soft": {"radius": 0.85},
    "soft, wide": {"radius": 1.4},
    "disc": {"footprint": "disc", "radius": 0.0015},
    "disc, the paper's gradients": {"footprint": "disc", "radius": 0.0015, "max_tracked": 3},
    "disc, wide": {"footprint": "disc", "radius": 0.11, "max_tracked": 5},
}


@pytest.mark.parametrize("blend", BLENDS)
@pytest.mark.parametrize("early_stop", [0.0, 0.001])
@pytest.mark.parametrize(
    "name, side", [*((name, 1) for name in SETTINGS), ("soft", 2), ("disc", 2)]
)
def test_image_and_gradients(dev, rng, name, side, early_stop, blend):
    settings = RasterConfig(blend=blend, early_stop=early_stop, **SETTINGS[name])
    model, camera = make_model(dev, rng), ring_cameras(1, 30)[0].crop(3, 4, 22, 17)
    k = side if blend == "alpha" else 1
    renderer = Renderer(dev, model, settings, supersampling=side)
    result = renderer.forward(camera, GAMMA, training=True)
    image = result.image.get()
    expected, backward = chained(model, settings, camera, k)
    assert image.shape == (20, 24, 3) and relative_error(image, expected) < 1e-5

    grad = rng.normal(size=image.shape).astype(np.float32)
    gradients, parts = renderer.backward(result, dev.upload(grad))
    visible = result.weights.visible.get()
    want_features, want_opacity, want_net = backward(grad)
    assert np.abs(want_features).max() > 0 and np.abs(want_opacity).max() > 0
    assert not np.delete(want_features, visible, axis=0).any()
    assert not np.delete(want_opacity, visible).any()
    features, opacity = gradients.visible_features.get(), gradients.opacity.get()
    assert relative_error(features[: len(visible)], want_features[visible]) < 5e-5
    assert relative_error(opacity[: len(visible)], want_opacity[visible]) < 5e-5
    for key, value in plain_parameters(model.net, model.net.sum_gradients(parts)).items():
        assert relative_error(value, want_net[key]) < 5e-5, key


def test_all_samples_of_a_pixel_share_its_fragments(dev, rng):
    model, camera = make_model(dev, rng), ring_cameras(1, 32)[0]
    fragments = {}
    for side in (1, 2):
        settings = RasterConfig(radius=0.85, early_stop=0.2)
        renderer = Renderer(dev, model, settings, supersampling=side)
        result = renderer.forward(camera, GAMMA, training=True)
        fragments[side], shown = result.fragments()
        assert (shown <= fragments[side]).all() and 0 < shown.sum() < fragments[side].sum()
    assert (fragments[2] >= fragments[1]).all() and fragments[2].sum() < 2.2 * fragments[1].sum()


def test_padding_does_not_move_the_image(dev, rng):
    model, camera = make_model(dev, rng), ring_cameras(1, 32)[0]
    renderer = Renderer(dev, model, RasterConfig(radius=0.85))
    whole = renderer.forward(camera, GAMMA, until="features").features.get()
    odd = camera.crop(5, 7, 21, 19)
    assert renderer.render(odd, GAMMA).shape == (19, 21, 3)
    result = renderer.forward(odd, GAMMA, until="features")
    left, top = result.offset
    inner = result.features.get()[top : top + 19, left : left + 21]
    np.testing.assert_allclose(inner, whole[7:26, 5:26], atol=2e-5)


def test_a_margin_is_the_image_around_it_and_no_training_has_one(dev, rng):
    model, camera = make_model(dev, rng), ring_cameras(1, 32)[0].crop(5, 7, 20, 18)
    settings = RasterConfig(blend="alpha", radius=0.85)
    plain, framed = (Renderer(dev, model, settings, 2, margin) for margin in (0, 4))
    larger = plain.render(camera.crop(-4, -5, 28, 28), GAMMA)
    result = framed.forward(camera, GAMMA)
    image = result.clamped()
    np.testing.assert_array_equal(image, larger[5:23, 4:24])
    assert (image != plain.render(camera, GAMMA)).any()
    assert framed.forward(camera, GAMMA, training=True).size == (20, 20) != result.size
    assert framed.forward(camera, GAMMA, until="features").size == (20, 20)


def test_an_empty_view_is_the_background(dev, rng):
    model, camera = make_model(dev, rng), ring_cameras(1, 16)[0]
    away = replace(camera, pose=camera.pose * [-1, 1, -1, 1])  # turned round
    renderer = Renderer(dev, model, RasterConfig(radius=0.85))
    result = renderer.forward(away, GAMMA, training=True)
    np.testing.assert_array_equal(result.features.get(), np.ones((16, 16, 16), np.float32))
    assert np.isfinite(result.image.get()).all()
    renderer.backward(result, dev.upload(np.ones((16, 16, 3), np.float32)))
    assert result.weights.visible.size == 0


def test_a_call_may_see_beyond_the_models_depth_range(dev, rng):
    model, camera = make_model(dev, rng), ring_cameras(1, 32)[0]
    renderer, far = Renderer(dev, model, RasterConfig(blend="alpha")), model.depth_range[1]
    back = camera.pose.copy()
    back[:, 3] -= 2 * far * back[:, 2]
    away = replace(camera, pose=back)
    assert renderer.forward(away, GAMMA, until="weights").pairs.total == 0
    result = renderer.forward(away, GAMMA, until="weights", depth_range=(far, 4 * far))
    assert result.pairs.total > 0


@pytest.mark.parametrize("blend", BLENDS)
def test_the_early_stop_of_a_call_is_that_of_other_settings(dev, rng, blend):
    model, camera = make_model(dev, rng, 300), ring_cameras(1, 32)[0]
    settings = RasterConfig(blend=blend, early_stop=0.0)
    renderer = Renderer(dev, model, settings)
    exact = renderer.render(camera, GAMMA)
    lasting = Renderer(dev, model, replace(settings, early_stop=0.2))
    other = lasting.render(camera, GAMMA)
    np.testing.assert_array_equal(renderer.render(camera, GAMMA, early_stop=0.2), other)
    assert (other != exact).any()
    np.testing.assert_array_equal(lasting.render(camera, GAMMA, early_stop=0.0), exact)


@pytest.mark.parametrize("blend", BLENDS)
def test_arrays_without_room_are_released_before_larger_ones_are_made(dev, rng, blend):
    settings = RasterConfig(blend=blend, radius=0.85)
    renderer = Renderer(dev, make_model(dev, rng, 300), settings)
    near, far = (ring_cameras(1, size)[0] for size in (192, 48))
    first = renderer.forward(far, GAMMA, until="weights").pairs.capacity
    dev.reset_peak()
    second = renderer.forward(near, GAMMA, until="weights").pairs.capacity
    assert 0 < 2 * first < second
    assert dev.peak_bytes == dev.bytes


def test_an_image_beyond_the_boxes_of_points_is_refused(dev, rng):
    camera = replace(ring_cameras(1, 16)[0], width=2**16)
    renderer = Renderer(dev, make_model(dev, rng), RasterConfig(radius=0.85))
    with pytest.raises(UserError, match="65536x16 pixels: at most 65535 each way"):
        renderer.forward(camera, GAMMA)
