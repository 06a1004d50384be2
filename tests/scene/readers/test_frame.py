"""What is taken for the pose of a camera, of whatever numbers a file holds."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from pp_cl.errors import UserError
from pp_cl.scene.readers.frame import rigid


@given(arrays.arrays(np.float64, (3, 4), elements=st.floats(-2, 2)))
def test_what_is_taken_for_a_pose_is_rigid(matrix):
    """Near to what was given, for random matrices and for rotations that are off by little."""
    u, _, vt = np.linalg.svd(matrix[:, :3])
    turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    near = np.column_stack([turn + 1e-5 * matrix[:, :3], matrix[:, 3]])
    for given_matrix in (matrix, near):
        try:
            pose = rigid(given_matrix, UserError)
        except UserError:
            assert given_matrix is matrix
            continue
        assert np.allclose(pose[:, :3] @ pose[:, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(pose[:, :3]) > 0
        assert np.abs(pose - given_matrix).max() < 1e-3
