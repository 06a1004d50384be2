import pytest

from pp_cl.bench.raster import BLENDS, SCENES, features_error

pytestmark = pytest.mark.usefixtures("quick")


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("blend", BLENDS)
def test_a_wrong_image_is_found(dev, name, blend):
    scene = SCENES[name](dev, 500, 16)
    features = scene.forward(blend).features.get()
    assert features_error(scene, blend, features) < 1e-4
    of_points = scene.exact_features()[:, 3]
    features[..., 3] += 0.1
    span = max(of_points.max(), 1) - min(of_points.min(), 1)
    assert features_error(scene, blend, features) == pytest.approx(0.1 / span, rel=1e-2)
