"""A small trained run, once for all tests of this wing."""

import pytest
from support.runs import arguments
from support.scenes import write_ball_scene

from pp_cl.cli import main
from pp_cl.compress.reduction import Original
from pp_cl.run import load_run


@pytest.fixture(scope="session")
def ball_run(tmp_path_factory):
    """Folder of a run of 60 steps on a ball that 9 training views see."""
    folder = tmp_path_factory.mktemp("compress")
    write_ball_scene(folder / "ball", views=9, size=40)
    changes = {"train__iterations": 60, "train__prune_every": 1000, "train__previews": 0}
    assert main(arguments(str(folder / "ball"), folder / "run", 1, **changes)) == 0
    return folder / "run"


@pytest.fixture
def original(dev, ball_run):
    return Original.of(load_run(dev, ball_run))
