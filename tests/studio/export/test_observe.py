import numpy as np
import pytest
from support.models import blend_matrix

from pp_studio.export.harmonics import observe


@pytest.fixture(autouse=True)
def observed_pixels(run, monkeypatch):
    """Renders with one sample a pixel, as observations do, so that both can be compared."""
    monkeypatch.setattr(run.renderer, "supersampling", 1)


def test_rows_sum_to_alpha_up_to_an_early_stop_and_columns_to_the_points_weights(run):
    for observation in observe(run, run.cameras("test"), "test"):
        matrix, weights = blend_matrix(observation), observation.point_weights()
        assert matrix.shape == (30 * 30, run.model.cloud.count) and weights.max() > 0.1
        assert matrix.sum(0) == pytest.approx(weights, abs=1e-5)
        alpha = run.render(observation.camera).alpha.ravel()
        missing = alpha - matrix.sum(1)
        stopped = missing > 1e-5
        assert stopped.any() and (alpha[stopped] == 1).all()
        assert missing.min() > -1e-5 and missing.max() < run.config.raster.early_stop


def test_it_blends_what_the_rasteriser_blends(run):
    camera = run.cameras("test")[0]
    (observation,) = observe(run, [camera], "test")
    matrix = blend_matrix(observation)
    raster = run.renderer.forward(camera, run.gamma, until="features")
    visible = raster.weights.visible.get()
    points = np.zeros((run.model.cloud.count, 16), np.float32)
    points[visible] = raster.visible_features.get()[: len(visible)]
    blended = matrix @ points + (1 - matrix.sum(1))[:, None]  # the background's features are 1
    features = run.render(camera, features=True).features.reshape(-1, 16)
    assert blended == pytest.approx(features, abs=1e-4)


def test_blending_and_gathering_are_the_matrix_and_its_transpose(run, rng):
    for observation in observe(run, run.cameras("test"), "test", blending=True):
        matrix = blend_matrix(observation)
        colours, values = rng.normal(size=(run.model.cloud.count, 3)), rng.normal(size=(900, 3))
        assert observation.gathered(values) == pytest.approx(
            (matrix.T @ values)[observation.visible], abs=1e-5
        )
        blended, rest = observation.blended(colours[observation.visible])
        assert blended == pytest.approx(matrix @ colours, abs=1e-5)
        assert rest == pytest.approx(1 - matrix.sum(1), abs=1e-5)
