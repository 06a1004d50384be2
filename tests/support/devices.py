"""Devices that are listed and never opened."""

from types import SimpleNamespace

import pyopencl as cl


def fake(platform, name, gpu=False, problem=None, index="0:0", version="1"):
    """An item of list_devices()."""
    device = SimpleNamespace(name=name, platform=SimpleNamespace(name=platform))
    device.type = cl.device_type.GPU if gpu else cl.device_type.CPU
    device.driver_version = version
    return index, device, problem
