"""tools/tune.py: what it tries runs, and the row that it prints is the fastest of it."""

from dataclasses import replace

import pytest

from pp_cl.bench.conv import Layer, UploadedLayer, layer_errors
from pp_cl.engine.layers.choice import OFFERED, blocking_of, device_class
from tools import tune as TOOL


@pytest.mark.usefixtures("cpu_form")
def test_the_fastest_candidates_make_the_row(dev, rng, monkeypatch, capsys):
    """As if fewer accumulators, and four tiles of one group together, were faster."""
    tried = []

    def runner(conv, variant, direction, blocking):
        tried.append((variant, direction, blocking))
        return lambda: blocking

    def interleave(runs):
        """{name: [milliseconds]}."""
        return {
            name: [run().accumulators + 100 * (run().winograd != (64, 4))]
            for name, run in runs.items()
        }

    monkeypatch.setattr(UploadedLayer, "runner", runner)
    monkeypatch.setattr(TOOL, "interleave", interleave)
    found = TOOL.tuned(dev, [UploadedLayer(dev, Layer.random(rng, (8, 8), (16,), 16))])
    assert found.winograd == (64, 4) and found.accumulators == 4
    assert found.direct == TOOL.CANDIDATES["CPU"][2][2][0]["direct"]
    assert {direction for _, direction, _ in tried} == {*TOOL.IMAGES, *TOOL.WEIGHTS}
    assert len(capsys.readouterr().out.splitlines()) == sum(
        len(candidates) for _, _, candidates in TOOL.CANDIDATES["CPU"]
    )


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
