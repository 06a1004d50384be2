"""Kernels that are built in processes beside the program."""

import numpy as np
import pytest

from pp_cl.layers.choice import make_policy
from pp_cl.network.aside import build_aside
from pp_cl.network.unet import UNet
from pp_cl.settings import NetworkConfig


@pytest.mark.parametrize("seconds", [0.0, 1e9])
def test_a_network_waits_for_what_is_built_aside(dev, monkeypatch, seconds):
    """Where the cache was cold, and only there."""
    settings = NetworkConfig(widths=(16, 32, 16))
    net = UNet.of_settings(dev, settings, make_policy(dev))
    monkeypatch.setattr(dev, "build_seconds", seconds)
    build_aside(net, settings, (16, 24))
    processes = list(net.builders)
    assert len(processes) == (2 if seconds and dev.is_cpu else 0)
    assert np.isfinite(net.forward(dev.zeros((16, 24, 16))).get()).all()
    assert [process.returncode for process in processes] == [0] * len(processes)
    assert not net.builders
