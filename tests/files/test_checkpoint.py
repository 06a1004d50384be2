"""Checkpoints: same content, same bytes; nothing half-written; nothing untrusted is believed."""

import errno
import zipfile

import numpy as np
import pytest
from support.checkpoints import load_checkpoint

from pp_cl.device.buffers import DeviceRows
from pp_cl.errors import Diverged, UserError
from pp_cl.files import atomic
from pp_cl.files.atomic import write_json
from pp_cl.files.checkpoint import check_finite, opened_checkpoint, save_checkpoint

ARRAYS = {
    "points.ids": np.arange(5, dtype=np.uint32),
    "points.opacity": np.linspace(0, 1, 5, dtype=np.float32),
}


def test_round_trip_and_equal_bytes(tmp_path):
    a, b = tmp_path / "a.npz", tmp_path / "b.npz"
    save_checkpoint(a, {"step": 3}, ARRAYS)
    save_checkpoint(b, {"step": 3}, ARRAYS)
    assert a.read_bytes() == b.read_bytes()
    with zipfile.ZipFile(a) as stored:  # compressed bytes could change with the version of zlib
        assert {entry.compress_type for entry in stored.infolist()} == {zipfile.ZIP_STORED}
    header, arrays = load_checkpoint(a)
    assert header["step"] == 3 and set(arrays) == set(ARRAYS)
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(arrays[name], array)


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


def test_arrays_in_pieces_give_the_bytes_of_whole_ones(dev, tmp_path):
    rows = {name: DeviceRows(dev, dev.upload(array)) for name, array in ARRAYS.items()}
    save_checkpoint(tmp_path / "a.npz", {"step": 3}, ARRAYS)
    save_checkpoint(tmp_path / "b.npz", {"step": 3}, rows)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


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
