import pytest

from pp_studio.view.server import started


@pytest.fixture(scope="session")
def trained(runs, scene, tmp_path_factory):
    """Folder of a finished run of the ball at 24 x 24 pixels. Tests must not change it."""
    return runs.trained(tmp_path_factory.mktemp("viewed") / "run", scene, train__iterations=40)


@pytest.fixture
def copied(trained, tmp_path):
    for name in ("config.json", "checkpoint.npz", "log.jsonl"):
        (tmp_path / name).write_bytes((trained / name).read_bytes())
    return tmp_path


@pytest.fixture
def served():
    """(viser's server with an empty page, its address)."""
    with started("test", port=0) as pair:
        yield pair
