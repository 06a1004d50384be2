"""Checkpoints: same content, same bytes; nothing half-written; nothing untrusted is believed."""

import errno
import zipfile

import numpy as np
import pytest

from pp_cl.engine.device.buffers import DeviceRows
from pp_cl.errors import Diverged, UserError
from pp_cl.files import atomic
from pp_cl.files.atomic import write_json
from pp_cl.files.checkpoint import check_finite, opened_checkpoint, save_checkpoint

ARRAYS = {
    "points.ids": np.arange(5, dtype=np.uint32),
    "points.opacity": np.linspace(0, 1, 5, dtype=np.float32),
}


def test_equal_content_gives_equal_bytes(dev, tmp_path):
    """Also where arrays come in pieces. That they come back: tests/test_properties.py."""
    rows = {name: DeviceRows(dev, dev.upload(array)) for name, array in ARRAYS.items()}
    for name, arrays in (("a", ARRAYS), ("b", ARRAYS), ("c", rows)):
        save_checkpoint(tmp_path / f"{name}.npz", {"step": 3}, arrays)
    assert len({path.read_bytes() for path in tmp_path.iterdir()}) == 1
    with zipfile.ZipFile(tmp_path / "a.npz") as stored:  # zlib's bytes could change with a version
        assert {entry.compress_type for entry in stored.infolist()} == {zipfile.ZIP_STORED}


def test_forms_and_single_arrays_are_read_without_the_others(tmp_path):
    path = tmp_path / "a.npz"
    arrays = ARRAYS | {"points.opacity": np.linspace(0, 1, 5000, dtype=np.float32)}
    save_checkpoint(path, {"step": 3}, arrays)
    data = bytearray(path.read_bytes())
    data[data.index(arrays["points.opacity"].tobytes())] ^= 1  # read, it is corrupt
    path.write_bytes(data)
    with opened_checkpoint(path) as stored:
        assert stored.header["step"] == 3
        assert {n: (f.shape, f.dtype) for n, f in stored.forms.items()} == {
            name: (array.shape, array.dtype) for name, array in arrays.items()
        }
        np.testing.assert_array_equal(stored.array("points.ids"), ARRAYS["points.ids"])
        with pytest.raises(UserError, match=r"a\.npz: corrupt checkpoint \(Bad CRC"):
            stored.array("points.opacity")
    with pytest.raises(UserError, match="no such checkpoint"), opened_checkpoint(tmp_path / "none"):
        pass


def test_a_header_that_could_not_be_read_is_not_written(tmp_path, monkeypatch):
    monkeypatch.setattr("pp_cl.files.checkpoint.MOST_HEADER", 100)
    save_checkpoint(tmp_path / "a.npz", {"step": 3}, ARRAYS)
    before = (tmp_path / "a.npz").read_bytes()
    with pytest.raises(UserError, match="a.npz: its header"):
        save_checkpoint(tmp_path / "a.npz", {"views": "x" * 100}, ARRAYS)
    assert (tmp_path / "a.npz").read_bytes() == before


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_never_written(tmp_path, value):
    path = tmp_path / "checkpoint.npz"
    save_checkpoint(path, {"step": 1}, ARRAYS)
    before = path.read_bytes()
    broken = {"whole": np.arange(3), "broken": np.array([[0, value]], np.float32)}
    with pytest.raises(Diverged, match="^broken holds NaN or Inf$"):
        save_checkpoint(path, {"step": 2}, broken)
    assert path.read_bytes() == before and [path] == list(tmp_path.iterdir())
    with pytest.raises(Diverged, match="^broken holds"):
        check_finite(broken)
    check_finite(ARRAYS)


def test_full_disk_keeps_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "checkpoint.npz"
    save_checkpoint(path, {"step": 1}, ARRAYS)
    before = path.read_bytes()

    def full(*_args, **_kwargs):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(atomic.os, "fsync", full)
    with pytest.raises(UserError, match="free some space") as caught:
        save_checkpoint(path, {"step": 2}, ARRAYS)
    assert str(path) in str(caught.value)
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == [path.name]


def test_json_never_holds_nan(tmp_path):
    with pytest.raises(ValueError, match="JSON compliant"):
        write_json(tmp_path / "a.json", {"x": float("nan")})
    assert not (tmp_path / "a.json").exists()
