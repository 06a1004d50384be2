"""A small run that all exports are made of."""

import pytest
from support.runs import arguments
from support.scenes import write_ball_scene

from pp_cl.cli import main
from pp_cl.run import load_run


@pytest.fixture(scope="session")
def run_folder(tmp_path_factory):
    """A finished run on the ball, of 30 x 30 pixels, which the renderer pads."""
    folder = tmp_path_factory.mktemp("export")
    scene = write_ball_scene(folder / "ball", size=60, views=12)
    changes = {"train__final_prune_weight": 0.0, "train__iterations": 300, "train__previews": 0}
    assert main(arguments(scene, folder / "run", **changes)) == 0
    return folder / "run"


@pytest.fixture(scope="session")
def run(session_device, run_folder):
    """The run, loaded."""
    return load_run(session_device, run_folder)
