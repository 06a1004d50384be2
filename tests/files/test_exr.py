"""OpenEXR files hold the values that went in."""

import numpy as np
import OpenEXR
import pytest

from pp_cl.errors import UserError
from pp_cl.files.exr import picture_channels, read_exr, write_exr
from pp_cl.files.picture import Picture


@pytest.fixture
def shown(rng):
    """A picture with features and a pixel of background."""
    alpha = rng.random((9, 4)).astype(np.float32)
    alpha[0, 0] = 0
    depth = np.where(alpha > 0, 4 * alpha, np.inf).astype(np.float32)
    colour = np.maximum(rng.random((9, 4, 3)), 1 - alpha[..., None]).astype(np.float32)
    features = rng.normal(size=(9, 4, 16)).astype(np.float32)
    return Picture(colour, alpha, depth, depth + 1, features)


def test_all_channels_come_back(shown, tmp_path):
    channels = picture_channels(shown)
    write_exr(tmp_path / "a.exr", channels)
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]
    there = OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True).channels()
    names = {*"RGBAZ", "mean.Z", *(f"feature.{i:02d}" for i in range(16))}
    assert there.keys() == names == read_exr(tmp_path / "a.exr").keys()
    for name, array in channels.items():
        assert there[name].pixels.dtype == np.float32
        np.testing.assert_array_equal(there[name].pixels, array)
        np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")[name], array)
    np.testing.assert_array_equal(there["A"].pixels, shown.alpha)
    np.testing.assert_array_equal(there["Z"].pixels, shown.median_depth)
    np.testing.assert_array_equal(there["mean.Z"].pixels, shown.depth)
    np.testing.assert_array_equal(there["feature.03"].pixels, shown.features[..., 3])
    assert np.isinf(there["Z"].pixels[0, 0]) and there["R"].pixels[0, 0] == 0


def test_a_broken_file_is_one_line(tmp_path):
    (tmp_path / "a.exr").write_bytes(b"no image")
    with pytest.raises(UserError, match="a.exr: cannot be read as OpenEXR"):
        read_exr(tmp_path / "a.exr")


def test_a_place_that_cannot_be_written_is_one_line(shown, tmp_path):
    with pytest.raises(UserError, match="a.exr: cannot be written"):
        write_exr(tmp_path / "missing" / "a.exr", picture_channels(shown))
