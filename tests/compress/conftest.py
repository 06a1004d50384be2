"""A small trained run, once for all tests of this wing."""

import pytest

from pp_cl.compress.reduction import Original
from pp_cl.run import load_run


@pytest.fixture(scope="session")
def ball_run(runs, tmp_path_factory):
    """Folder of a run of 60 steps on a ball that 9 training views see."""
    changes = {"train__iterations": 60, "train__prune_every": 1000}
    out = tmp_path_factory.mktemp("compress") / "run"
    return runs.trained(out, runs.ball(views=9, size=40), 1, **changes)


@pytest.fixture
def original(dev, ball_run):
    return Original(load_run(dev, ball_run))
