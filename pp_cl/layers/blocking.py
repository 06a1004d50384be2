"""How the convolution kernels cut their work into pieces that fit registers and caches."""

from dataclasses import dataclass

from pp_cl.device.device import Device
from pp_cl.layers.tiles import LANES


@dataclass(frozen=True)
class Blocking:
    """Sizes that kernels are built and launched with. They change speed, and the rounding of
    winograd_backward_weights.cl, which sums `winograd_weights` tiles at a time.

    direct: (pixels of a row, groups of 16 output channels, work-group) of a work-item of conv.cl,
    where the groups come in multiples of that number; direct_odd: the same for other channels.
    accumulators: float16 sums that a work-item of conv_backward_weights.cl keeps in registers;
    work_group: its work-group, None = the launcher's default. winograd: (tiles transformed at a
    time, tiles multiplied together) of winograd.cl; winograd_narrow: the same for few channels
    (winograd.NARROW). winograd_weights: tiles transformed at a time
    by winograd_backward_weights.cl.
    """

    direct: tuple[int, int, tuple[int, int, int]]
    direct_odd: tuple[int, int, tuple[int, int, int]]
    accumulators: int
    work_group: tuple[int, int, int] | None
    # More tiles at a time use the transformed weights better, fewer leave more room in the caches.
    # The second number divides the first: with 2 x 16 channels, 8 take 16 of AVX-512's 32 vectors,
    # 12 take 24.
    winograd: tuple[int, int] = (64, 8)
    winograd_narrow: tuple[int, int] = (12, 12)
    winograd_weights: int = 32

    def of_direct(self, width: int, channels_out: int) -> tuple[int, int, tuple[int, int, int]]:
        """(pixels, groups of channels, work-group) of conv.cl for an image `width` wide."""
        pixels, groups, work_group = self.direct
        if -(-channels_out // LANES) % groups:
            pixels, groups, work_group = self.direct_odd
        return next(p for p in (pixels, 8, 4, 1) if p <= width), groups, work_group


# A CPU core has 32 vector registers. Where groups of 16 channels pair up, two share each input
# value and take 8 pixels: 16 accumulators and 6 weights; else one takes 12. A GPU's work-item has
# about 255 scalar registers, and a float16 takes 16 of them: 4 pixels.
SHIPPED = {
    "CPU": Blocking((8, 2, (1, 1, 1)), (12, 1, (1, 1, 1)), 24, (1, 1, 1)),
    "GPU": Blocking((4, 1, (16, 4, 1)), (4, 1, (16, 4, 1)), 6, None),
}
# {class of device: {field of Blocking: the values that `pp-cl tune` tries, the shipped one first}}
CHOICES = {
    "CPU": {
        "winograd": ((64, 8), (32, 8), (128, 8), (64, 4), (64, 2)),
        "winograd_narrow": ((12, 12), (16, 8), (32, 8), (16, 4), (16, 2)),
        "winograd_weights": (32, 16, 64),
        "direct": ((8, 2, (1, 1, 1)), (4, 2, (1, 1, 1)), (12, 1, (1, 1, 1)), (6, 1, (1, 1, 1))),
    },
    "GPU": {
        "direct": (
            (4, 1, (16, 4, 1)),
            (4, 1, (8, 8, 1)),
            (4, 1, (32, 2, 1)),
        ),
    },
}


def device_class(dev: Device) -> str:
    """The key of a device in SHIPPED and CHOICES: "CPU", or "GPU" for every other device."""
    return "CPU" if dev.is_cpu else "GPU"


def shipped_blocking(dev: Device) -> Blocking:
    """The blocking of a device that has not been tuned."""
    return SHIPPED[device_class(dev)]
