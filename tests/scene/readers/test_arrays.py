"""Arrays of other programs: read without trust. The readers' tests have the broken ones."""

import numpy as np

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
