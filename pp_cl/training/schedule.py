"""Learning rates, gamma and averaging weights as pure functions of the step, which counts from 0 to
steps - 1.
"""

import math

AVERAGE_EVERY = 10  # steps


def learning_rate(step, steps, first, last, delay_steps=0, delay_factor=0.01):
    """Exponential decay from `first` to `last`, held down by `delay_factor` at first (mip-NeRF's
    learning_rate_decay).

    delay_steps: the hold ends there, as a quarter sine; 0 = none.
    """
    rate = first * (last / first) ** min(step / steps, 1)
    if delay_steps == 0:
        return rate
    return rate * (
        delay_factor + (1 - delay_factor) * math.sin(math.pi / 2 * min(step / delay_steps, 1))
    )


def gamma(step, steps, first=0.1, last=0.01):
    """The blend's softness, exponential from `first` to `last` (PlenopticPoints supplemental)."""
    return learning_rate(step, steps, first, last)


def average_weight(step, steps):
    """Weight of the current parameters in their running average; 0 where no update is due.

    The average starts as a copy (weight 1) at 7/10 of the steps, then takes 1 - exp(-10/(steps/20))
    every 10 steps: a time constant of a twentieth of the training.
    """
    since = step - 7 * steps // 10
    if since < 0 or since % AVERAGE_EVERY:
        return 0.0
    return 1.0 if since == 0 else 1 - math.exp(-AVERAGE_EVERY / (0.05 * steps))
