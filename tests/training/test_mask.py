"""What the mask term does: it takes away what exceeds the outline, and fills what looks like the
background.
"""

import numpy as np
from support.runs import arguments
from support.scenes import write_ball_scene

from pp_cl import load
from pp_cl.cli import main


def test_the_mask_is_learned(tmp_path):
    """The alpha of the test views is nearer to that of the photographs, and exceeds it less."""
    scene, errors = write_ball_scene(tmp_path / "ball"), []
    for weight in (0, 3):
        out = tmp_path / str(weight)
        assert main(arguments(scene, out, train__mask_weight=weight)) == 0
        run = load(out)
        views = run.scene("test").splits["test"]
        alphas = [(run.render(view.camera).alpha, reduced_alpha(view)) for view in views]
        difference = np.array([rendered - given for rendered, given in alphas])
        errors.append((np.maximum(difference, 0).mean(), np.maximum(-difference, 0).mean()))
    (excess, shortfall), (excess_left, shortfall_left) = errors
    assert excess_left < 0.8 * excess and shortfall_left < 0.9 * shortfall


def reduced_alpha(view):
    """(H, W) of the reduced photograph."""
    k, camera = view.downscale, view.camera
    alpha = view.image[..., 3].reshape(camera.height, k, camera.width, k)
    return alpha.mean(axis=(1, 3)) / 255
