"""The schedules of a training: learning rates, gamma, loss weights, and when it prunes, refines,
averages and supersamples. They are functions of its progress, which goes from 0 to 1: the share of
train.iterations that is done, or of train.minutes that has passed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from pp_cl.settings import NetworkConfig, TrainConfig

GAMMA = (0.1, 0.01)  # depth sharpness of the softmax, first and last step (supplemental)
SH_DECAY = 0.1  # last over first learning rate of the SH (supplemental)
SH_DELAY = (0.0, 0.01, 0.02)  # progress until which SH degrees 0, 1, 2 warm up
SMOOTHING_EVERY = 64  # steps
PRUNE_LOOKS = 100  # steps that must have had a point in view before it may be pruned
EMA_FROM = 0.85  # progress at which averages begin
EMA_UPDATES = 200  # times the averages would be updated in the whole training
EMA_TIME = 0.05  # their time constant
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
    def at(cls, progress: float, steps: float, network: NetworkConfig, train: TrainConfig) -> Rates:
        """The rates of a step. steps: how many the training has in all."""
        # in a long training these travel about as far as in a short one: at full rates they end
        # noisier
        scale = math.sqrt(min(1.0, train.rate_steps / steps or 1.0))
        sh = tuple(
            slower * learning_rate(progress, first, first * SH_DECAY, delay) if first else 0.0
            for first, delay, slower in zip(
                train.sh_rate, SH_DELAY, (1.0, scale, scale), strict=True
            )
        )
        opacity = scale * learning_rate(progress, *train.opacity_rate)
        return cls(
            sh,
            learning_rate(progress, *train.offset_rate) if train.offset_rate[0] else 0.0,
            opacity,
            0.0 if train.view_opacity == "off" else opacity,
            learning_rate(progress, *network.rate),
        )


def learning_rate(progress: float, first: float, last: float, delay: float = 0.0) -> float:
    """Exponential decay from `first` to `last` with a warm-up (mip-NeRF's learning_rate_decay).

    The warm-up multiplies by DELAYED at first and rises to 1 at the progress `delay` as a quarter
    sine; delay 0: none.
    """
    rate = first * (last / first) ** min(progress, 1)
    if delay == 0:
        return rate
    return rate * (DELAYED + (1 - DELAYED) * math.sin(math.pi / 2 * min(progress / delay, 1)))


def supersampling_at(progress: float, train: TrainConfig) -> int:
    """RenderResult.supersampling of a step, and of renderings made before the next one."""
    return 2 if train.supersampled > 0 and progress >= 1 - train.supersampled else 1


def prunings(train: TrainConfig, start: int, end: int) -> int:
    """How many prunings between the steps `start` and `end` may drop points, if the points are seen
    in every step since `start`.
    """
    if train.prune_weight == 0:
        return 0
    every, last = train.prune_every, min(end, train.iterations - 1)
    return max(0, last // every - -(-(start + PRUNE_LOOKS) // every) + 1)


def refinements(train: TrainConfig) -> list[float]:
    """The progresses at which the grid is refined, ascending.

    Each refinement makes eight points of one. So a training of so many iterations that prunes
    leaves out a refinement before which nothing could have been pruned since the last one.
    """
    shares = sorted({share for share in train.refine_at if 0 < share < 1})
    kept = shares[:1]
    for share in shares[1:]:
        between = (round(at * train.iterations) for at in (kept[-1], share))
        if train.minutes or train.prune_weight == 0 or prunings(train, *between):
            kept.append(share)
    return kept


def growths(train: TrainConfig) -> list[float]:
    """The progresses from which on a training takes more memory."""
    averaged = [EMA_FROM] if train.ema else []
    return [
        *refinements(train),
        *averaged,
        *([1 - train.supersampled] if train.supersampled else []),
    ]


def has_passed(share: float, before: float, after: float) -> bool:
    """Whether a step passes this share, which takes the progress from `before` to `after`."""
    return before < share <= after


def gamma_at(progress: float) -> float:
    """Depth sharpness gamma of the softmax, exponential along GAMMA."""
    return learning_rate(progress, *GAMMA)


def rising_weight(progress: float, last: float = 1.0) -> float:
    """A loss weight that rises linearly from 0 to `last`, for the distortion loss and for alphas
    below the mask: at first there is no surface that these could make sharp or opaque.
    """
    return last * progress


def late_weight(progress: float, last: float) -> float:
    """A loss weight that is 0 in the first three quarters of a training and rises to `last` in a
    twentieth, for the depth loss: a surface must be found before it can be smoothed.
    """
    return last * min(1.0, max(0.0, (progress - 0.75) / 0.05))


def ema_weight(before: float, after: float) -> float:
    """Weight of the present parameters in their exponential moving average, after a step that takes
    the progress from `before` to `after`; 0 where no update is due.

    The average starts as a copy (weight 1) at EMA_FROM, and is updated EMA_UPDATES times in a whole
    training, or each step if these are fewer, with a time constant of EMA_TIME.
    """
    if after < EMA_FROM:
        return 0.0
    if before < EMA_FROM:
        return 1.0
    # counted from EMA_FROM; a rounding below a whole number counts as that
    first, last = (math.floor((at - EMA_FROM) * EMA_UPDATES + 1e-6) for at in (before, after))
    return 1 - math.exp(-(last - first) / (EMA_TIME * EMA_UPDATES))
