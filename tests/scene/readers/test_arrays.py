"""Arrays of other programs: read without trust. The readers' tests have the broken ones."""

import zipfile

import numpy as np
import pytest

from pp_cl.errors import UserError
from pp_cl.scene.readers import arrays
from pp_cl.scene.readers.arrays import read_npy, read_npz, read_numbers


def test_what_numpy_writes(tmp_path, rng):
    array = rng.normal(size=(4, 3))
    for index, stored in enumerate((array, np.asfortranarray(array), array.astype("<f4"))):
        np.save(tmp_path / f"{index}.npy", stored)
        np.testing.assert_array_equal(read_npy(tmp_path / f"{index}.npy"), stored)
    np.save(tmp_path / "whole.npy", np.array([[1, -2]], np.int16))
    assert read_npy(tmp_path / "whole.npy").tolist() == [[1, -2]]
    np.savez_compressed(tmp_path / "a.npz", cam_1=array, other=array)
    assert list(read_npz(tmp_path / "a.npz", "cam_")) == ["cam_1"]


def test_lines_of_numbers(tmp_path):
    (tmp_path / "a.txt").write_text("1 2.5\n\n-3e2\n")
    assert read_numbers(tmp_path / "a.txt") == [[1, 2.5], [-300]]


# --------------------------------------------------------------------------------------------------

FLOATS = "{'descr': '<f8', 'fortran_order': False, 'shape': %s}"
HEADERS = {
    "open bracket": "{'descr': '<f8', 'fortran_order': False, 'shape': (3,",
    "negative": FLOATS % "(-1, 4)",
    "twice negative": FLOATS % "(-1, -4)",
    "nothing times much": FLOATS % f"(0, {10**30})",
    "too many dimensions": FLOATS % f"({'1, ' * 70})",
    "no type": "{'descr': [], 'fortran_order': False, 'shape': (2,)}",
    "pairs": "{'descr': ('<f8', (2,)), 'fortran_order': False, 'shape': (2,)}",
    "bytes beyond memory": FLOATS.replace("<f8", "<u1") % f"({2**26},)",
    "nested": "(" * 500,
}


def of_header(text):
    """A .npy file with this header and 16 numbers."""
    header = text.encode().ljust(1000) + b"\n"
    return b"\x93NUMPY\x01\0" + len(header).to_bytes(2, "little") + header + bytes(128)


def unreadable(read, *given):
    with pytest.raises(UserError, match="cannot be read .*; copy it anew") as caught:
        read(*given)
    assert str(given[0]) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("case", HEADERS)
def test_headers_that_lie(tmp_path, case):
    (tmp_path / "a.npy").write_bytes(of_header(HEADERS[case]))
    unreadable(read_npy, tmp_path / "a.npy")
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.write(tmp_path / "a.npy", "cam.npy")
    unreadable(read_npz, tmp_path / "a.npz", "cam")


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_compressed_file_with_a_changed_byte(tmp_path, rng, method):
    """Wherever it is, one line says so, unless the byte does not matter."""
    np.save(tmp_path / "a.npy", rng.normal(size=(3, 4)))
    with zipfile.ZipFile(tmp_path / "a.npz", "w", method) as archive:
        archive.write(tmp_path / "a.npy", "cam.npy")
    data, refusals = (tmp_path / "a.npz").read_bytes(), 0
    for place in range(len(data)):
        changed = bytearray(data)
        changed[place] ^= 0xFF
        (tmp_path / "a.npz").write_bytes(changed)
        try:
            read_npz(tmp_path / "a.npz", "cam")
        except UserError as error:
            refusals += 1
            assert "\n" not in str(error)
    assert refusals > len(data) // 2


def test_all_arrays_of_a_file_count(tmp_path, monkeypatch):
    """Small as each may be: 16 numbers fit, two arrays of 9 do not."""
    monkeypatch.setattr(arrays, "MOST_BYTES", 128)
    np.savez(tmp_path / "a.npz", cam_1=np.zeros(16), other=np.zeros(9))
    assert len(read_npz(tmp_path / "a.npz", "cam_")) == 1
    np.savez(tmp_path / "b.npz", cam_1=np.zeros(9, "<f4"), cam_2=np.zeros(9, "<f4"))
    unreadable(read_npz, tmp_path / "b.npz", "cam_")
