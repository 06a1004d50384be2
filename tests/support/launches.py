"""Check the results of a kernel whose launch is cut into parts for a watchdog."""

import numpy as np

from pp_cl.engine.device import device


def check_parts(dev, monkeypatch, kernel, run):
    """Assert that run(), an array or a tuple of arrays, gives the same bits if every launch is cut
    as finely as possible. Returns how often the kernel was launched then.
    """
    whole = run()
    launched, attempt = [], dev.attempt

    def counted(what, function, *args, **named):
        launched.append(what)
        return attempt(what, function, *args, **named)

    with monkeypatch.context() as patch:
        patch.setattr(device, "MOST_MULTIPLY_ADDS", 1)
        patch.setattr(dev, "has_watchdog", True)
        patch.setattr(dev, "attempt", counted)
        parts = run()
    if isinstance(whole, tuple):
        for actual, expected in zip(parts, whole, strict=True):
            np.testing.assert_array_equal(actual, expected)
    else:
        np.testing.assert_array_equal(parts, whole)
    return sum(what.endswith(f":{kernel}") for what in launched)
