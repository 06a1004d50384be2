"""What a kernel computes in several launches, as for a watchdog."""

import numpy as np

from pp_cl.engine.device import device


def check_parts(dev, monkeypatch, kernel, run):
    """run(), an array or a tuple of them, has the same bits with every launch cut as finely as can
    be. Returns how often the kernel was launched then.
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
