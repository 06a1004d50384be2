"""One small run for the tests of the viewer."""

import pytest
from support.runs import arguments
from support.scenes import write_ball_scene

from pp_cl.cli import main


@pytest.fixture(scope="session")
def trained(tmp_path_factory):
    """Folder of a finished run of the ball, 24 x 24 pixels; not to be changed."""
    folder = tmp_path_factory.mktemp("viewed")
    scene = write_ball_scene(folder / "ball")
    assert main(arguments(scene, folder / "run", train__iterations=40)) == 0
    return folder / "run"


@pytest.fixture
def copied(trained, tmp_path):
    """A copy of that run, for tests that change it."""
    for name in ("config.json", "checkpoint.npz", "log.jsonl"):
        (tmp_path / name).write_bytes((trained / name).read_bytes())
    return tmp_path
