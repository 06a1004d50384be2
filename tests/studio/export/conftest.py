import pytest

from pp_cl.run import load


@pytest.fixture(scope="session")
def run_folder(runs, tmp_path_factory):
    """A finished run on the ball at 30 x 30 pixels, which the renderer must pad."""
    changes = {"train__prune_weight": 0.0, "train__iterations": 300}
    out = tmp_path_factory.mktemp("export") / "run"
    return runs.trained(out, runs.ball(size=60, views=12), **changes)


@pytest.fixture(scope="session")
def run(session_device, run_folder):
    return load(run_folder, session_device)
