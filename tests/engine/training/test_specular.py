"""The specular layer that is fitted once a training has ended, alone and in trainings."""

import numpy as np
import pytest
from support.checkpoints import load_checkpoint
from support.models import make_model
from support.runs import arguments, checkpoint, rows
from support.scenes import ring_cameras

from pp_cl.bench.unet import plain_parameters
from pp_cl.cli import main
from pp_cl.engine.network.specular import INPUTS, Specular
from pp_cl.engine.render import Renderer
from pp_cl.engine.training import specular
from pp_cl.engine.training.specular import SpecularFit, fit_steps, gradient_of_squares
from pp_cl.engine.views import View
from pp_cl.reference.differences import numeric_gradient
from pp_cl.reference.network import network
from pp_cl.settings import RasterConfig

GAMMA, STEPS = 0.03, 200
LIGHT = np.array([-0.8, 0.0, -0.6])


def directions(camera):
    rays = camera.rays()
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


class Shown:
    """Views of a model. Each target adds lacking(view's index, camera), times alpha, to the model's
    image.
    """

    def __init__(self, dev, rng, views, lacking):
        model = make_model(dev, rng, n=300)
        self.renderer = Renderer(dev, model, RasterConfig(radius=1.4))
        cameras = ring_cameras(views, size=36, distance=3.0)
        zeros = np.zeros((36, 36, 4), np.uint8)
        self.views = [View(f"{i}.png", camera, zeros) for i, camera in enumerate(cameras)]
        self._lacking = lacking

    def target(self, index):
        camera = self.views[index].camera
        rendered = self.renderer.forward(camera, GAMMA)
        alpha = 1 - rendered.cropped(rendered.transmittance.get().reshape(rendered.size))
        missing = alpha[..., None] * self._lacking(index, camera)
        return rendered.dev.upload(rendered.cropped(rendered.image.get()) + missing, np.float32)

    def fitted(self, seed=0):
        return SpecularFit(self.renderer, self.views, self.target, GAMMA, seed).fitted(STEPS)


def lobe(index, camera):
    return 0.3 * np.maximum(directions(camera) @ LIGHT, 0)[..., None] ** 4 * [1.0, 0.8, 0.5]


@pytest.mark.large
def test_a_lobe_is_found_and_shown(dev, rng):
    shown = Shown(dev, rng, 9, lobe)
    fitted = shown.fitted()
    assert fitted.scale > 0.9
    assert fitted.after < 0.1 * fitted.before
    camera = ring_cameras(18, size=36, distance=3.0)[1]  # between the others
    rendered = shown.renderer.forward(camera, GAMMA)
    alpha = 1 - rendered.cropped(rendered.transmittance.get().reshape(rendered.size))
    before = rendered.cropped(rendered.image.get())
    shown.renderer.model.specular = fitted.layer
    after = rendered.cropped(shown.renderer.forward(camera, GAMMA).image.get())
    wanted = alpha[..., None] * lobe(0, camera)
    error = np.square(after - before - wanted).mean() / np.square(wanted).mean()
    assert error < 0.2
    assert (after[alpha < 0.02] == before[alpha < 0.02]).all()


@pytest.mark.large
def test_the_same_seed_gives_the_same_layer(dev, rng):
    shown = Shown(dev, rng, 9, lobe)
    layers = [shown.fitted(seed).layer.all_parameters.get() for seed in (0, 0, 1)]
    assert (layers[0] == layers[1]).all() and (layers[0] != layers[2]).any()


@pytest.mark.large
def test_what_other_views_contradict_is_left_out(dev, rng):
    noise = rng.normal(size=(9, 3)) * 0.1
    noise -= noise.mean(axis=0)
    fitted = Shown(dev, rng, 9, lambda index, _: noise[index]).fitted()
    assert fitted.layer is None and fitted.scale < specular.LEAST_SCALE
    assert fitted.after == fitted.before


@pytest.mark.parametrize(
    "views, lacking", [(1, lobe), (4, lambda *_: np.zeros(3))], ids=["one view", "nothing"]
)
def test_without_anything_to_tell_there_is_none(dev, rng, views, lacking):
    fitted = Shown(dev, rng, views, lacking).fitted()
    assert fitted.layer is None and fitted.scale == 0 and np.isfinite(fitted.before)


@pytest.mark.large
def test_views_that_lack_the_same_get_it(dev, rng):
    fitted = Shown(dev, rng, 4, lambda *_: np.full(3, 0.1)).fitted()
    assert fitted.scale > 0.95 and fitted.after < 0.01 * fitted.before


def test_longer_trainings_get_longer_fits(monkeypatch):
    monkeypatch.setattr(specular, "STEPS", (600, 1500))
    assert [fit_steps(n) for n in (20, 6000, 22000)] == [600, 1200, 1500]


def test_its_gradient_is_that_of_finite_differences(dev, rng):
    layer = Specular(dev)
    x = rng.normal(size=(4, 4, INPUTS)).astype(np.float32)
    wanted = rng.random((4, 4, 3)).astype(np.float32)
    gradient = dev.empty(wanted.shape)
    gradient_of_squares(dev, layer.forward(dev.upload(x)), dev.upload(wanted), gradient)
    _, parts = layer.backward(gradient)
    gradients = plain_parameters(layer, layer.sum_gradients(parts))
    parameters = plain_parameters(layer, layer.parameters)
    for name, computed in gradients.items():

        def loss(values, name=name):
            image = network(layer.layers, parameters | {name: values}, x)["image"]
            return np.square(image - wanted).mean()

        indices = rng.choice(computed.size, min(computed.size, 20), replace=False)
        expected = numeric_gradient(loss, parameters[name], 1e-6, indices)
        assert computed.ravel()[indices] == pytest.approx(expected, rel=1e-3, abs=1e-7)


# ---- in trainings


def test_ignored_pixels_are_not_looked_at(dev, rng):
    shown = Shown(dev, rng, 4, lobe)
    for view in shown.views:
        object.__setattr__(view, "ignored", np.ones((36, 36), bool))
    assert shown.fitted().layer is None


@pytest.fixture
def always(monkeypatch):
    """Make a training keep its layer, however little that explains."""
    monkeypatch.setattr(specular, "LEAST_SCALE", -1.0)


def test_a_training_keeps_it_and_an_extended_one_fits_it_anew(scene, tmp_path, always, capsys):
    out, steps = tmp_path / "run", 20
    assert main(arguments(scene, out, train__iterations=steps)) == 0
    assert "specular: kept at " in capsys.readouterr().out
    header, arrays = load_checkpoint(out / "checkpoint.npz")
    assert header["specular"] and rows(out)[-1]["specular"] >= 0
    before = {name: array for name, array in arrays.items() if name.startswith("specular.")}
    assert len(before) == 6
    assert main(["eval", str(out)]) == 0
    assert main(arguments(scene, out, train__iterations=steps + 5)) == 0
    _, arrays = load_checkpoint(out / "checkpoint.npz")
    assert all((arrays[name] != array).any() for name, array in before.items())


def test_a_kill_within_the_fit_resumes_to_the_same_bytes(scene, tmp_path, always, monkeypatch):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    words = {"train__iterations": 20, "train__checkpoint_every": 5}
    assert main(arguments(scene, whole, **words)) == 0
    with monkeypatch.context() as patch:
        patch.setattr(SpecularFit, "fitted", interrupted)
        assert main(arguments(scene, killed, **words)) == 130
    assert load_checkpoint(killed / "checkpoint.npz")[0]["step"] == 15
    assert main(arguments(scene, killed, **words)) == 0
    assert checkpoint(whole) == checkpoint(killed)


def interrupted(*_):
    raise KeyboardInterrupt


def test_without_it_nothing_is_stored(scene, tmp_path, always, capsys):
    out = tmp_path / "run"
    assert main(arguments(scene, out, train__iterations=5, train__specular="off")) == 0
    assert "specular" not in capsys.readouterr().out
    header, arrays = load_checkpoint(out / "checkpoint.npz")
    assert "specular" not in header and not any("specular" in name for name in arrays)
