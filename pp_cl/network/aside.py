"""Builds a network's kernels in two processes beside the program, which find their way back through
the driver's cache on disk: a driver like PoCL builds one kernel at a time in a process.
"""

import json
import subprocess
import sys
from dataclasses import asdict
from typing import IO, cast

from pp_cl.device.discover import open_device
from pp_cl.layers.choice import make_policy
from pp_cl.network.unet import UNet
from pp_cl.settings import NetworkConfig

COLD = 0.08  # seconds to build a program, on average, where the cache holds none


def build_aside(net: UNet, settings: NetworkConfig, size: tuple[int, int]) -> None:
    """Start to build what `net`, of these settings, trains with on crops of size (height, width),
    if the programs so far were not in a cache; its next forward pass waits for it. What fails there
    is built when it is needed.
    """
    dev = net.dev
    if not dev.is_cpu or dev.build_seconds <= COLD * dev.programs_built:
        return
    given = {
        "device": dev.name,
        "network": asdict(settings),
        "tuning": net.policy.tuning,
        "size": size,
    }
    for of_weights in (False, True):
        process = subprocess.Popen(
            [sys.executable, "-m", __name__],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        with cast(IO[bytes], process.stdin) as stdin:
            stdin.write(json.dumps(given | {"of_weights": of_weights}).encode())
        net.builders.append(process)


def main() -> None:
    """What such a process does, told on stdin."""
    given = json.load(sys.stdin)
    dev, settings = open_device(given["device"]), NetworkConfig(**given["network"])
    policy = make_policy(dev, settings.tolerance, given["tuning"])
    UNet.of_settings(dev, settings, policy).build(tuple(given["size"]), given["of_weights"])


if __name__ == "__main__":
    main()
