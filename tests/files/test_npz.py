"""What numpy's savez wrote is read as it was; broken files are tried in training/test_stored.py."""

import zipfile

import numpy as np
import pytest

from pp_cl.files.npz import NpzFile

ARRAYS = {
    "a": np.arange(24, dtype=np.float32).reshape(2, 3, 4),
    "b.c": np.array([1, 2**32 - 1], np.uint32),
    "half": np.linspace(0, 1, 7, dtype=np.float16).reshape(7, 1),
    "bytes": np.frombuffer(b"\xff\0", np.uint8),
    "none": np.zeros((0, 5), np.float32),
    "one": np.array(3.5),
    "many": np.arange(10**6, dtype=np.int64),
}


def test_forms_and_values_are_numpys(tmp_path, monkeypatch):
    monkeypatch.setattr("pp_cl.files.npz.PIECE_BYTES", 1000)
    np.savez(tmp_path / "a.npz", **ARRAYS)
    file = NpzFile(tmp_path / "a.npz")
    assert file.forms == {name: (a.shape, a.dtype) for name, a in ARRAYS.items()}
    assert str(file.forms["half"]) == "float16 (7, 1)"
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(file.read(name), array)
    file.close()


def test_other_arrays_than_asked_for_may_be_damaged(tmp_path):
    np.savez(tmp_path / "a.npz", **ARRAYS)
    data = bytearray((tmp_path / "a.npz").read_bytes())
    data[data.index(ARRAYS["many"].tobytes()) + 5 * 10**6] ^= 1
    (tmp_path / "a.npz").write_bytes(data)
    file = NpzFile(tmp_path / "a.npz")
    np.testing.assert_array_equal(file.read("a"), ARRAYS["a"])
    with pytest.raises(ValueError, match="Bad CRC"):
        file.read("many")
    file.close()


def test_errors_of_the_system_stay_what_they_are(tmp_path):
    with pytest.raises(FileNotFoundError):
        NpzFile(tmp_path / "none.npz")
    with pytest.raises(OSError, match="directory"):
        NpzFile(tmp_path)


def test_a_refused_file_is_closed(tmp_path, recwarn):
    np.savez_compressed(tmp_path / "a.npz", **ARRAYS)
    opened = []

    class Noting(zipfile.ZipFile):
        def __init__(self, *args, **named):
            super().__init__(*args, **named)
            opened.append(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(zipfile, "ZipFile", Noting)
        with pytest.raises(ValueError, match="a is not stored as it is"):
            NpzFile(tmp_path / "a.npz")
    assert len(opened) == 1 and opened[0].fp is None
