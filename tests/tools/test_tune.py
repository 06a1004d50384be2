"""tools/tune.py: what it tries runs, and the row that it prints is the fastest of it."""

from dataclasses import replace

import pytest

from pp_cl.bench.conv import Layer, layer_errors
from pp_cl.engine.layers.choice import OFFERED, blocking_of, device_class
from tools import tune as TOOL


@pytest.mark.slow
def test_every_candidate_is_right(dev, rng):
    """On a layer whose groups of channels come in pairs, and on one of three groups."""
    for co in (32, 48):
        layer = Layer.random(rng, (12, 12), (32,), co)
        for variants in TOOL.CANDIDATES.values():
            for variant, directions, candidates in variants:
                for fields in candidates if variant in OFFERED[device_class(dev)] else ():
                    blocking = replace(blocking_of(dev), **fields)
                    computed = layer.computed(dev, variant, blocking)
                    for direction in directions:
                        assert layer_errors(layer, computed, direction)[0] < 1e-5
