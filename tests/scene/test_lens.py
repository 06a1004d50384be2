import json
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from support.transforms_scenes import refused, write_scene

from pp_cl.engine.camera import Camera
from pp_cl.errors import UserError
from pp_cl.files.image import read_rgba
from pp_cl.scene import lens
from pp_cl.scene.image_file import shrink
from pp_cl.scene.lens import LensDistortion, undistort
from pp_cl.scene.load import load_scene

CAMERA = Camera(np.eye(3, 4), 150.0, 140.0, 84.0, 57.5, 161, 120)
LENSES = {
    "barrel": LensDistortion(k1=-0.2, k2=0.03),
    "pincushion": LensDistortion(k1=0.15),
    "tangential": LensDistortion(p1=0.01, p2=-0.008),
    "all": LensDistortion(-0.15, 0.04, 0.004, -0.003, 0.01),
    "fisheye": LensDistortion(fisheye=True),
    "bent fisheye": LensDistortion(k1=0.04, k2=-0.02, k3=0.01, k4=-0.004, fisheye=True),
}


def test_the_formula_by_hand():
    """At x = 0.3, y = -0.2, r^2 is 0.13."""
    x, y = LensDistortion(0.1, 0.01, 0.002, -0.003, 0.5).apply(np.array(0.3), np.array(-0.2))
    radial = 1 + 0.1 * 0.13 + 0.01 * 0.13**2 + 0.5 * 0.13**3
    assert x == pytest.approx(0.3 * radial + 2 * 0.002 * -0.06 - 0.003 * (0.13 + 2 * 0.09))
    assert y == pytest.approx(-0.2 * radial + 0.002 * (0.13 + 2 * 0.04) + 2 * -0.003 * -0.06)


def test_a_fisheye_by_hand():
    """A direction t radians off the axis appears t + k1 t^3 + ... + k4 t^9 focal lengths from the
    centre.
    """
    lens, turn = LENSES["bent fisheye"], np.array([np.cos(0.7), np.sin(0.7)])
    for t in (0, 0.3, 1.2):
        expected = t + 0.04 * t**3 - 0.02 * t**5 + 0.01 * t**7 - 0.004 * t**9
        assert lens.apply(*(np.tan(t) * turn)) == pytest.approx(expected * turn, abs=1e-14)


def test_without_coefficients_nothing_changes(dev, rng):
    image = rng.integers(0, 256, (120, 161, 4), np.uint8)
    image[..., 3] = 255
    assert not LensDistortion() and LensDistortion(k3=1e-9)
    assert np.array_equal(undistort(dev, image, CAMERA, LensDistortion()), image)


@pytest.mark.parametrize("name", LENSES)
def test_opencv_undistorts_alike(dev, name):
    """Colours and alpha agree within two levels of 255; a shift by a pixel would change seven."""
    cv2, lens = pytest.importorskip("cv2"), LENSES[name]
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    value = np.rint(127 + 60 * np.sin(u / 9) + 60 * np.cos(v / 7)).astype(np.uint8)
    matrix = np.array([[CAMERA.fx, 0, CAMERA.cx - 0.5], [0, CAMERA.fy, CAMERA.cy - 0.5], [0, 0, 1]])
    radial, end = (lens.k1, lens.k2), (matrix, (CAMERA.width, CAMERA.height), cv2.CV_32FC1)
    if lens.fisheye:
        coefficients = np.array([*radial, lens.k3, lens.k4])
        maps = cv2.fisheye.initUndistortRectifyMap(matrix, coefficients, np.eye(3), *end)
    else:
        coefficients = np.array([*radial, lens.p1, lens.p2, lens.k3])
        maps = cv2.initUndistortRectifyMap(matrix, coefficients, None, *end)
    expected = cv2.remap(value, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).astype(int)
    assert np.abs(expected - value).max() > 10, "a lens that moves nothing tests nothing"
    opaque, white = np.full_like(value, 255), np.full_like(value, 200)
    for image, channel in (
        (np.dstack([value, value, value, opaque]), 0),
        (np.dstack([white, white, white, value]), 3),
    ):
        undistorted = undistort(dev, image, CAMERA, lens)[..., channel]
        assert np.abs(undistorted - expected).max() <= 2


@pytest.mark.parametrize("name", LENSES)
def test_one_colour_stays_one_colour(dev, name):
    """Colours of transparent pixels do not bleed into their neighbours."""
    image = np.full((120, 161, 4), (200, 30, 90, 255), np.uint8)
    assert np.array_equal(undistort(dev, image, CAMERA, LENSES[name]), image)
    image[:, :80] = (0, 255, 0, 0)
    undistorted = undistort(dev, image, CAMERA, LENSES[name])
    shown = undistorted[undistorted[..., 3] > 30][:, :3].astype(int)
    assert np.abs(shown - [200, 30, 90]).max() <= 4


def test_threads_take_turns_on_the_device(monkeypatch):
    """Each kernel keeps the arguments of one launch."""
    busy = threading.Lock()

    def undistorted(*_):
        assert busy.acquire(blocking=False)
        time.sleep(0.01)
        busy.release()

    monkeypatch.setattr(lens, "_undistorted", undistorted)
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda _: undistort(None, None, CAMERA, LENSES["all"]), range(8)))


def test_a_lens_that_folds_is_refused(tmp_path):
    """For k1 = -1 the image folds, 1 + 3 k1 r^2 < 0, from r = 0.58 on."""
    assert LensDistortion(k1=float("nan")).folds(CAMERA)
    assert LensDistortion(k1=-1.0).folds(CAMERA) and not LensDistortion(k1=-0.5).folds(CAMERA)
    data = write_scene(tmp_path)
    data["k1"] = -9.0
    (tmp_path / "transforms_train.json").write_text(json.dumps(data))
    refused(tmp_path, tmp_path / "train_0.png", "fold the image over")


def test_images_of_a_scene_are_undistorted(dev, tmp_path):
    data = write_scene(tmp_path)
    data.update(k1=0.3, p1=0.01, camera_model="OPENCV")
    (tmp_path / "transforms_train.json").write_text(json.dumps(data))
    with pytest.raises(UserError, match="its images have distortion, which only a device removes"):
        load_scene(tmp_path)
    for view in load_scene(tmp_path, dev=dev).splits["train"]:
        stored = read_rgba(tmp_path / view.name)
        expected = undistort(dev, stored, view.stored_camera, LensDistortion(k1=0.3, p1=0.01))
        np.testing.assert_array_equal(view.image, expected)
        assert (view.image != stored).any()


@pytest.mark.parametrize("factor", (2, 3, 5))
def test_reducing_a_warp_as_it_is_read_is_reducing_the_warped_image(dev, data, factor):
    """99.9 % of the pixels are at most a level of 255 apart, as the whole warp is rounded once
    more. If the image is reduced first and then warped, a fifth of them differ by more.
    """
    image = read_rgba(data / "ethiopian_head_photos/DSC_0033.jpg")
    camera = Camera(np.eye(3, 4), 1200.0, 1200.0, 503.0, 495.0, 1000, 1000)
    whole = undistort(dev, image, camera, LENSES["barrel"])
    undistorted = undistort(dev, image, camera, LENSES["barrel"], factor)
    reduced = shrink(whole, factor)
    assert (np.abs(undistorted.astype(int) - reduced) <= 1).all(2).mean() >= 0.999
    first = undistort(dev, shrink(image, factor), camera.downscaled(factor), LENSES["barrel"])
    assert (np.abs(first.astype(int) - reduced) <= 1).all(2).mean() < 0.9
