"""Times the values that a row of the table in pp_cl/engine/layers/choice.py may have, on this
device, and prints the row with the fastest ones.

    python -m tools.tune [--device D]

Each field is timed with the best values of those before it, over the 3x3 convolutions of the preset
tiny's network at SIDE x SIDE pixels. Times are medians of interleaved runs. Run it twice on a quiet
machine: fields that differ between the two runs do not matter.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pp_cl.bench.conv import Layer, UploadedLayer
from pp_cl.bench.timing import interleave
from pp_cl.config import preset
from pp_cl.drivers import open_device
from pp_cl.engine.device.device import Device
from pp_cl.engine.layers.choice import blocking_of, device_class
from pp_cl.engine.layers.conv import Blocking
from pp_cl.engine.network.layers import convolutions, unet_layers

SIDE = 96
BOTH, BACKWARD = ("forward", "backward"), ("backward",)
# {class of device: [(variant, directions, values of fields to try)]}
CANDIDATES: dict[str, Any] = {
    "CPU": [
        (
            "winograd",
            BOTH,
            [
                {"winograd_groups": groups, "winograd": (64, n), "winograd_narrow": narrow}
                for groups, n, narrow in (
                    (2, 8, (12, 12)),
                    (2, 8, (16, 8)),
                    (2, 4, (16, 4)),
                    (2, 2, (16, 2)),
                    (1, 8, (24, 8)),
                    (1, 4, (24, 4)),
                    (1, 4, (64, 4)),
                    (1, 2, (24, 2)),
                )
            ],
        ),
        ("winograd", BACKWARD, [{"winograd_weights": n} for n in (16, 32, 64)]),
        (
            "direct",
            BOTH,
            [
                {"direct": pair, "direct_odd": odd}
                for pair, odd in (
                    ((8, 2), (12, 1)),
                    ((4, 2), (8, 1)),
                    ((2, 2), (4, 1)),
                    ((6, 1), (6, 1)),
                    ((4, 1), (4, 1)),
                )
            ],
        ),
        ("direct", BACKWARD, [{"accumulators": n} for n in (24, 12, 6, 4)]),
    ],
    "GPU": [("direct", BACKWARD, [{"accumulators": n} for n in (6, 12)])],
}


def network_convolutions(dev: Device) -> list[UploadedLayer]:
    """The 3x3 convolutions of the preset tiny's network, on random data."""
    network, rng = preset("tiny").network, np.random.default_rng(0)
    return [
        UploadedLayer(dev, Layer.random(rng, (SIDE >> at.level,) * 2, at.sources, at.channels))
        for at in convolutions(unet_layers(network.widths, blocks=network.blocks))
        if at.kernel_size == 3
    ]


def tuned(dev: Device, convs: Sequence[UploadedLayer]) -> Blocking:
    """The device's shipped row with the fastest of CANDIDATES; prints their times."""
    blocking = blocking_of(dev)
    for variant, directions, candidates in CANDIDATES[device_class(dev)]:
        tried = [replace(blocking, **fields) for fields in candidates]
        ms = np.zeros(len(tried))
        for conv in (conv for conv in convs if variant in conv.variants):
            for direction in directions:
                runs = {i: conv.runner(variant, direction, b) for i, b in enumerate(tried)}
                ms += [np.median(times) for times in interleave(runs).values()]
        for fields, total in zip(candidates, ms, strict=True):
            print(f"{variant} {'/'.join(directions)} {fields}: {total:.2f} ms")
        blocking = tried[int(ms.argmin())]
    return blocking


def main() -> None:
    """Measure; print the times and the row."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--device", help="as `pp-cl train` takes it")
    dev = open_device(parser.parse_args().device)
    print(f"{dev.name}, vectors of {dev.device.native_vector_width_float} floats")
    print(tuned(dev, network_convolutions(dev)))


if __name__ == "__main__":
    main()
