import io
import weakref
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from pp_cl.files.image import read_rgba
from pp_cl.files.rendered_view import RenderedView, mean_rendered_view
from pp_cl.files.srgb import linear_to_srgb, srgb_to_linear


def view_and_colours(rng, height=7, width=5):
    """(RenderedView, straight colours) of a known object over white."""
    straight = rng.random((height, width, 3)).astype(np.float32)
    alpha = rng.random((height, width)).astype(np.float32)
    alpha[0], alpha[1] = 0, 1
    colour = straight * alpha[..., None] + 1 - alpha[..., None]
    depth = np.where(alpha > 0, 3 + alpha, np.inf).astype(np.float32)
    return RenderedView(colour, alpha, depth, depth), straight


def test_it_is_what_the_object_shows_over_a_colour(rng):
    shown, straight = view_and_colours(rng)
    over = shown.over((0.2, 0.4, 0.6))
    alpha = shown.alpha[..., None]
    expected = straight * alpha + (1 - alpha) * np.float32([0.2, 0.4, 0.6])
    np.testing.assert_allclose(over, expected, atol=1e-6)
    np.testing.assert_allclose(shown.over((1, 1, 1)), shown.colour, atol=1e-6)


def test_straight_colours_come_back(rng):
    shown, straight = view_and_colours(rng)
    rgba, channels = shown.rgba(), shown.channels()
    np.testing.assert_array_equal(rgba[..., 3], shown.alpha)
    visible = shown.alpha > 0.05
    np.testing.assert_allclose(rgba[visible][:, :3], straight[visible], atol=1e-5)
    assert np.isfinite(rgba).all()
    light = srgb_to_linear(straight) * shown.alpha[..., None]  # as OpenEXR keeps it
    linear = np.dstack([channels[name] for name in "RGB"])
    np.testing.assert_allclose(linear[visible], light[visible], atol=1e-5)


def test_transfer_functions_are_inverse():
    values = np.linspace(0, 1, 1001, dtype=np.float32)
    np.testing.assert_allclose(linear_to_srgb(srgb_to_linear(values)), values, atol=1e-5)
    # IEC 61966-2-1: 18 % gray is at 46 % of the signal
    assert srgb_to_linear(np.float32(0.4613)) == pytest.approx(0.18, abs=1e-4)


def test_it_is_saved_and_shown_in_a_notebook(rng, tmp_path):
    shown, _ = view_and_colours(rng)
    shown.save(tmp_path / "white.png")
    shown.save(tmp_path / "clear.png", background=None)
    white, clear = (read_rgba(tmp_path / f"{name}.png") for name in ("white", "clear"))
    assert (white[..., 3] == 255).all() and (clear[0, :, 3] == 0).all()
    there = np.array(Image.open(io.BytesIO(shown._repr_png_())))
    np.testing.assert_array_equal(there, white[..., :3])


@pytest.mark.parametrize("n", [1, 4])
def test_the_mean_of_samples(rng, n):
    samples, held = [view_and_colours(rng)[0] for _ in range(n)], []

    def drawn():
        for sample in samples:
            assert sum(alive() is not None for alive in held) <= 2
            copied = replace(sample)
            held.append(weakref.ref(copied))
            yield copied
            del copied

    mean = mean_rendered_view(drawn())
    for name in ("colour", "alpha"):
        of_all = np.mean([getattr(sample, name) for sample in samples], axis=0)
        np.testing.assert_array_equal(getattr(mean, name), of_all)
        assert getattr(mean, name).dtype == np.float32
    np.testing.assert_array_equal(mean.depth, samples[0].depth)
