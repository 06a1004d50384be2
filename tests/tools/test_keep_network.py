"""tools/keep_network.py: what it keeps is the network of the run."""

import numpy as np
from support.checkpoints import load_checkpoint

from tools import keep_network as TOOL


def test_the_network_of_a_run_is_kept(finished, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(TOOL, "DEMO_NETWORK", tmp_path / "demo.npz")
    monkeypatch.setattr("sys.argv", ["keep_network", str(finished)])
    TOOL.main()
    assert "wrote" in capsys.readouterr().out
    _, arrays = load_checkpoint(finished / "checkpoint.npz")
    with np.load(tmp_path / "demo.npz") as stored:
        assert sorted(stored) == sorted(name for name in arrays if name.startswith("net."))
        for name, array in stored.items():
            np.testing.assert_array_equal(array, arrays[name].astype(np.float16))
