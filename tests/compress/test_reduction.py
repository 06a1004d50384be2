"""Reduced models: which points stay, what their coefficients become."""

import numpy as np
import pytest

from pp_cl.compress.reduction import heaviest, measured_psnr, nbytes, point_weights
from pp_cl.metrics.psnr_ssim import Metrics


@pytest.mark.parametrize(
    ("share", "expected"),
    [(1.0, [0, 1, 2, 3, 4]), (0.6, [1, 2, 4]), (0.4, [1, 4]), (0.01, [4]), (0, [4])],
)
def test_the_heaviest_points(share, expected):
    """Of equal ones the first; one at least."""
    kept = heaviest(np.array([0, 3, 2, 2, 7], np.float32), share)
    assert kept.tolist() == expected


def test_weights_are_the_most_over_the_views(original):
    """Of one view the sums of its blend matrix; of several the largest of them."""
    run = original.run
    cameras = run.cameras("train")
    single = [point_weights(run, [camera]) for camera in cameras]
    assert np.array_equal(original.weights, np.max(single, axis=0))
    alpha, stop = run.render(cameras[0]).alpha, run.config.raster.early_stop
    assert single[0].sum() == pytest.approx(
        alpha.sum(), rel=stop
    )  # what is behind it weighs nothing
    assert len(np.unique(single, axis=0)) == len(cameras)


def test_a_run_as_it_is_stays_as_it_is(original):
    same = original.reduced(1.0, half=False)
    assert same.config == original.run.config
    for name, array in original.run.model.arrays().items():
        assert np.array_equal(same.model.arrays()[name].get(), array.get())


def test_fewer_points_of_16_bits(original):
    arrays = original.reduced_arrays(0.5, half=True)
    kept = heaviest(original.weights, 0.5)
    assert len(kept) == round(len(original.weights) / 2)
    assert np.array_equal(arrays["points.ids"], original.arrays["points.ids"][kept])
    for degree in (0, 1, 2):
        exact = original.arrays[f"points.sh{degree}"][kept]
        found = arrays[f"points.sh{degree}"]
        assert found.dtype == np.float16
        assert np.abs(found - exact).max() <= np.abs(exact).max() * 2**-11
    network = sum(a.nbytes for name, a in arrays.items() if name.startswith("net."))
    run = original.reduced(0.5, half=True)
    assert nbytes(run) == len(kept) * (4 + 16 + 4 + 9 * 16 * 2) + network
    assert run.model.cloud.count == len(kept)
    assert np.isfinite(run.render(run.cameras("train")[0]).colour).all()


def test_16_bits_hold_what_is_larger(original):
    original.arrays["points.sh0"][0, 0, :2] = [1e6, -1e6]
    arrays = original.reduced_arrays(1.0, half=True)
    assert arrays["points.sh0"][0, 0, :2].tolist() == [65504, -65504]


def test_psnr_is_the_mean_over_the_views(original):
    run = original.run
    views = run.scene("test").splits["test"][:3]
    measure = Metrics(None, ("psnr",))
    single = [measured_psnr(run, [view]) for view in views]
    assert measured_psnr(run, views) == pytest.approx(np.mean(single))
    colour = run.render(views[0].camera).colour
    truth = views[0].image[..., :3] / 255
    alpha = views[0].image[..., 3:] / 255
    assert single[0] == pytest.approx(
        measure(colour, np.float32(truth * alpha + 1 - alpha))["psnr"], abs=0.01
    )
