"""The schedules of a training, as functions of the step (0 to steps - 1): learning rates, gamma,
loss weights, pruning, refining and EMA.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from pp_cl.settings import NetworkConfig, TrainConfig

GAMMA = (0.1, 0.01)  # depth sharpness of the softmax, first and last step (supplemental)
SH_DECAY = 0.1  # last over first learning rate of the SH (supplemental)
SH_DELAY = (0.0, 0.01, 0.02)  # warm-up of SH degrees 0, 1, 2, as a share of the iterations
SMOOTHING_EVERY = 64  # steps
PRUNE_LOOKS = 100  # steps that must have had a point in view before it may be pruned
EMA_UPDATES = 200  # times the averages would be updated in all steps; the last 15 % do
DELAYED = 0.01  # of a learning rate, at the first step of its warm-up
# About the share of the points that pruning leaves by the next refinement or the last step: 0.45 to
# 0.73 on lego with the presets tiny, small and full.
LEFT_BY_PRUNING = 0.6


@dataclass(frozen=True)
class Rates:
    """The learning rates of one step. sh: of the degrees 0, 1, 2. offset: 0 for points that stay
    on the grid. lobe: of the opacities' harmonics of degree 1.
    """

    sh: tuple[float, ...]
    offset: float
    opacity: float
    lobe: float
    network: float

    @classmethod
    def at(cls, step: int, network: NetworkConfig, train: TrainConfig) -> Rates:
        """The rates of a step from 0 on."""
        steps = train.iterations
        # in a long training these travel about as far as in a short one: at full rates they end
        # noisier
        scale = math.sqrt(min(1.0, train.rate_steps / steps or 1.0))
        sh = tuple(
            slower
            * learning_rate(step, steps, first, first * SH_DECAY, delay_steps=round(delay * steps))
            if first
            else 0.0
            for first, delay, slower in zip(
                train.sh_rate, SH_DELAY, (1.0, scale, scale), strict=True
            )
        )
        opacity = scale * learning_rate(step, steps, *train.opacity_rate)
        return cls(
            sh,
            learning_rate(step, steps, *train.offset_rate) if train.offset_rate[0] else 0.0,
            opacity,
            0.0 if train.view_opacity == "off" else opacity,
            learning_rate(step, steps, *network.rate),
        )


def learning_rate(
    step: int, steps: int, first: float, last: float, *, delay_steps: int = 0
) -> float:
    """Exponential decay from `first` to `last` with a warm-up (mip-NeRF's learning_rate_decay).

    The warm-up multiplies by DELAYED at step 0 and rises to 1 at `delay_steps` as a quarter sine;
    delay_steps 0: none.
    """
    rate = first * (last / first) ** min(step / steps, 1)
    if delay_steps == 0:
        return rate
    return rate * (DELAYED + (1 - DELAYED) * math.sin(math.pi / 2 * min(step / delay_steps, 1)))


def supersampled_from(train: TrainConfig) -> int:
    """The first step, from 0 on, that is supersampled; train.iterations for none."""
    return round((1 - train.supersampled) * train.iterations)


def supersampling_at(step: int, train: TrainConfig) -> int:
    """RenderResult.supersampling of a step, counted from 0, and of renderings made before it."""
    return 2 if train.supersampled > 0 and step >= supersampled_from(train) else 1


def prunings(train: TrainConfig, start: int, end: int) -> int:
    """How many prunings between the steps `start` and `end` may drop points, if the points are seen
    in every step since `start`.
    """
    if train.prune_weight == 0:
        return 0
    every, last = train.prune_every, min(end, train.iterations - 1)
    return max(0, last // every - -(-(start + PRUNE_LOOKS) // every) + 1)


def refine_steps(train: TrainConfig) -> list[int]:
    """The steps after which the grid is refined, ascending.

    Each refinement makes eight points of one. So a training that prunes leaves out a refinement
    before which nothing could have been pruned since the last one.
    """
    shares = (share for share in train.refine_at if 0 < share < 1)
    steps = sorted({max(1, round(share * train.iterations)) for share in shares})
    kept = steps[:1]
    for step in steps[1:]:
        if prunings(train, kept[-1], step) or train.prune_weight == 0:
            kept.append(step)
    return kept


@dataclass(frozen=True)
class Stretch:
    """A run of steps without a refinement. points: expected at its beginning. refinements: still to
    come. is_averaged: averages are kept. supersampling: as RenderResult.supersampling.
    """

    points: int
    refinements: int
    is_averaged: bool
    supersampling: int


def expected_stretches(train: TrainConfig, points: int, step: int) -> Iterator[Stretch]:
    """The stretches of a training that has `points` points at `step`. The numbers of points that
    later prunings leave are estimates.
    """
    refined, averaged, start = refine_steps(train), averages_from(train), 0
    ends = {*refined, int(min(averaged, train.iterations)), supersampled_from(train)}
    stages = 0, *refined, train.iterations
    for end in sorted(ends | {train.iterations}):
        if step < end:
            now = max(start, step)
            refinements = sum(now < at for at in refined)
            yield Stretch(points, refinements, averaged <= now, supersampling_at(now, train))
            stage = max(at for at in stages if at <= start), min(at for at in stages if at >= end)
            to_come = prunings(train, now, end) / max(1, prunings(train, *stage))
            points = round(points * LEFT_BY_PRUNING**to_come) * (8 if end in refined else 1)
        start = end


def averages_from(train: TrainConfig) -> float:
    """The step from which on averages are kept, infinite for never."""
    return ema_start(train.iterations) if train.ema else math.inf


def gamma_at(step: int, steps: int) -> float:
    """Depth sharpness gamma of the softmax, exponential along GAMMA."""
    return learning_rate(step, steps, *GAMMA)


def rising_weight(step: int, steps: int, last: float = 1.0) -> float:
    """A loss weight that rises linearly from 0 to `last`, for the distortion loss and for alphas
    below the mask: at first there is no surface that these could make sharp or opaque.
    """
    return last * step / steps


def late_weight(step: int, steps: int, last: float) -> float:
    """A loss weight that is 0 in the first three quarters of the steps and rises to `last` within a
    twentieth, for the depth loss: a surface must be found before it can be smoothed.
    """
    return last * min(1.0, max(0.0, (step / steps - 0.75) / 0.05))


def ema_start(steps: int) -> int:
    """The step after which the EMA begins."""
    return 17 * steps // 20


def ema_weight(step: int, steps: int) -> float:
    """Weight of the present parameters in their exponential moving average; 0 where no update is
    due.

    The average starts as a copy (weight 1) at 17/20 of the steps, then takes 1 - exp(-k/(steps/20))
    every k = steps/200 steps: a time constant of a twentieth of the training, in ten updates.
    """
    every, since = max(1, steps // EMA_UPDATES), step - ema_start(steps)
    if since < 0 or since % every:
        return 0.0
    return 1.0 if since == 0 else 1 - math.exp(-every / (0.05 * steps))
