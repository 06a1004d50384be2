from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d, zoom
from skimage.measure import find_contours

from pp_cl import RenderedView
from pp_cl.run import load
from pp_studio.large import parts, render_large, smooth_outlines, woven

N = 4  # pixels of an image along a pixel of the training


@pytest.fixture
def run(runs, scene, tmp_path, dev):
    return load(device=dev, folder=runs.trained(tmp_path / "run", scene, train__iterations=150))


def test_it_is_woven_of_images_at_the_scale_of_the_training(run):
    camera = run.cameras("test")[0]
    assert parts(run, camera) == 1
    large = camera.resized(4 * camera.width - 3, 4 * camera.height - 5)  # no multiples of a block
    calls = []
    whole = woven(run, large, N, lambda: calls.append(1))
    assert len(calls) == 16 == parts(run, large) ** 2
    assert whole.colour.shape == (large.height, large.width, 3)
    assert whole.alpha.shape == whole.depth.shape == whole.median_depth.shape
    small = replace(
        large,
        fx=large.fx / 4,
        fy=large.fy / 4,
        cx=large.cx / 4,
        cy=large.cy / 4,
        width=24,
        height=24,
    )
    # pixel (x, y) of a 4 x 4 block lies (x + 0.5) / 4 - 0.5 small pixels from the block's middle
    part = run.render(small.shifted(1.5 / 4 - 0.5, 3.5 / 4 - 0.5), supersampling=1)
    for name in ("colour", "alpha", "depth"):
        rows, columns = getattr(whole, name)[3::4, 1::4].shape[:2]
        expected = getattr(part, name)[:rows, :columns]
        assert np.array_equal(getattr(whole, name)[3::4, 1::4], expected)
    drawn, expected = render_large(run, large), smooth_outlines(whole, N)
    np.testing.assert_array_equal(drawn.colour, expected.colour)
    np.testing.assert_array_equal(drawn.alpha, expected.alpha)
    np.testing.assert_array_equal(drawn.depth, whole.depth)
    calls.clear()
    finer = render_large(run, large, samples=4, on_part=lambda: calls.append(1))
    corners = [(x, y) for y in (-0.25, 0.25) for x in (-0.25, 0.25)]
    alphas = [woven(run, large.shifted(*corner), N, lambda: None).alpha for corner in corners]
    mean = smooth_outlines(replace(whole, alpha=np.mean(alphas, 0)), N).alpha
    np.testing.assert_allclose(finer.alpha, mean, atol=1e-6)
    assert len(calls) == 64


def teeth(alpha):
    """Root mean square distance, in pixels, of the ball's outline from a smooth one."""
    outline = max(find_contours(alpha, 0.5), key=len)
    radius = np.linalg.norm(outline - outline.mean(0), axis=1)
    return float(np.std(radius - gaussian_filter1d(radius, N, mode="wrap")))


def test_an_outline_is_as_smooth_as_that_of_an_enlarged_image(run):
    camera = run.cameras("test")[0]
    large = camera.resized(N * camera.width, N * camera.height)
    enlarged = zoom(run.render(camera).alpha, N, order=1, grid_mode=True, mode="nearest")
    combed = woven(run, large, N, lambda: None).alpha
    mended = teeth(render_large(run, large).alpha)
    assert mended < teeth(enlarged) < teeth(combed)


def drawn(radius):
    """A 240x240 view, gold with stripes within a radius over white, and (240, 240) distances from
    its middle.
    """
    y, x = np.mgrid[:240, :240] - 119.5
    alpha = np.clip(radius(np.arctan2(y, x)) - np.hypot(x, y) + 0.5, 0, 1).astype(np.float32)
    gold = np.stack([0.8 + 0.2 * np.sin(x), 0.6 + 0 * x, 0.1 + 0 * x], 2)
    colour = (alpha[..., None] * gold + 1 - alpha[..., None]).astype(np.float32)
    return RenderedView(colour, alpha, alpha, alpha), np.hypot(x, y)


def test_teeth_are_taken_away_and_nothing_else():
    number = round(2 * np.pi * 90 / N)
    combed, distance = drawn(lambda angle: 90 + np.sin(number * angle))
    plain, _ = drawn(lambda angle: 90 + 0 * angle)
    mended = smooth_outlines(combed, N)
    assert teeth(mended.alpha) < 0.2 * teeth(combed.alpha)
    assert mended.alpha.sum() == pytest.approx(combed.alpha.sum(), rel=1e-3)
    for name in ("alpha", "colour"):
        before, after, wanted = (getattr(view, name) for view in (combed, mended, plain))
        assert np.abs(after - wanted).mean() < 0.8 * np.abs(before - wanted).mean()
    inside = distance < 70
    np.testing.assert_array_equal(mended.colour[inside], combed.colour[inside])
    kept = smooth_outlines(plain, N)
    assert np.abs(kept.alpha - plain.alpha).mean() < 2e-3
    assert teeth(kept.alpha) <= teeth(plain.alpha)
    nothing, _ = drawn(lambda angle: -1 + 0 * angle)
    np.testing.assert_array_equal(smooth_outlines(nothing, N).colour, nothing.colour)


def test_a_camera_that_is_near_is_a_large_one(run):
    camera, centre = run.cameras("test")[0], run.ball[0]
    large = camera.resized(128, 128)
    pose = camera.pose.copy()
    pose[:, 3] = centre + (camera.eye - centre) / 2
    assert parts(run, replace(camera.resized(64, 64), pose=pose)) == parts(run, large) == 4
    assert parts(run, camera.resized(20, 20)) == 1
