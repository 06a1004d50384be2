"""The learning rates of a step, and that lazy Adam shows points where dense Adam would."""

from functools import partial

import numpy as np
import pytest
from support.scenes import write_ball_scene

from pp_cl.files.run_folder import RunFolder
from pp_cl.run import open_training
from pp_cl.run_config import run_config
from pp_cl.settings import NetworkConfig, TrainConfig
from pp_cl.training.optimiser import Rates

CONSTANT = {
    "points.count": 1500,
    "network.widths": "16,16,16",
    "network.rate": "1e-6,1e-6",  # the images stay comparable
    "train.opacity_rate": "1e-6,1e-6",
    "train.sh_rate_decay": 1,  # what was skipped is caught up with at the present rate
    "train.sh_delay": "0,0,0",
    "train.sh_smoothing": 0,
    "train.dropout": 0,
    "train.crop": 12,
    "train.sh_eps": 1e-9,
}


@pytest.mark.parametrize(
    "steps, meant_for, scale", [(100, 1000, 1), (1000, 1000, 1), (9000, 1000, 1 / 3), (9000, 0, 1)]
)
def test_opacities_are_slower_in_longer_trainings(steps, meant_for, scale):
    settings = TrainConfig(iterations=steps, opacity_rate_steps=meant_for)
    first, last = (Rates.at(step, NetworkConfig(), settings) for step in (0, steps))
    assert (first.opacity, last.opacity) == pytest.approx((0.1 * scale, 0.01 * scale))
    assert (first.network, last.network) == pytest.approx((1e-3, 1e-4))


def features_after(dev, folder, scene, steps, lazy):
    """(the features of a whole view after some steps, those without what is pending)."""
    settings = CONSTANT | {"train.lazy_adam": lazy}
    changes = [(key, value, "settings") for key, value in settings.items()]
    folder = RunFolder(folder)
    trainer = open_training(dev, folder, run_config(folder, scene, None, changes), None).trainer
    for _ in range(steps):
        trainer.train_step()
    camera, optimiser = trainer.views[0].camera, trainer.optimiser
    rates = Rates.at(steps, trainer.network, trainer.config)
    pending = partial(
        optimiser.add_pending, steps + 1, rates, sh_eps=trainer.config.sh_eps / (3 * 12 * 12)
    )
    rasterise = partial(trainer.renderer.rasterise, camera, 0.1)
    return rasterise(add_pending=pending).features.get(), rasterise().features.get()


def test_lazy_adam_shows_points_where_dense_adam_would(dev, tmp_path):
    """Crops of a sixteenth of the image, so that points skip steps; the bias corrections of the
    first ten steps, which change, keep the two from being one.
    """
    scene = write_ball_scene(tmp_path / "ball")
    start, _ = features_after(dev, tmp_path / "start", scene, 0, False)
    dense, same = features_after(dev, tmp_path / "dense", scene, 10, False)
    np.testing.assert_array_equal(dense, same)
    lazy, late = features_after(dev, tmp_path / "lazy", scene, 10, True)
    moved = np.linalg.norm(dense - start)
    error, without = (np.linalg.norm(x - dense) / moved for x in (lazy, late))
    assert error < 0.1 and without > 0.4
