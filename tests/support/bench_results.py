"""What all benches give, made up."""

NETWORK_ROW = {
    "shape": [64, 64, 16],
    "gflops": 12.34,
    "ms_range": [1.5, 9.25],
    "rel_l2": 1.5e-7,
    "max_err": 2e-6,
}


def network_row(variant, direction, ms, **changes):
    return {"variant": variant, "direction": direction, "ms": ms} | NETWORK_ROW | changes


def result():
    """Numbers that differ from each other in their first digits."""
    raster = {"blend": "alpha", "tau": 0.001, "size": 200, "pairs": 4711, "max_err": 3.3e-7}
    raster |= {"forward_ms": 5.71, "backward_ms": 1.62}
    stage = {"ms": 33.21, "least": 30.06, "most": 41.84}
    return {
        "device": "A <device> & more",
        "platform": "a platform",
        "driver": "1.2",
        "version": "0.1.0",
        "convolutions": "as shipped",
        "budget": 120.0,
        "seconds": 118.4,
        "conv": [network_row("direct", "forward", 7.77, layer="enc0.a")],
        "unet": [network_row("direct", "train", 2.5), network_row("other", "train", 3.75)],
        "raster": [
            raster | {"points": n, "ms": ms, "ms_range": [ms / 2, ms * 2]}
            for n, ms in ((1000, 6.5), (2000, 8.25))
        ],
        "growth": [
            {"size": 200, "blend": "alpha", "tau": 0.001, "exponent": 0.34, "steepest": 0.56}
        ],
        "training": {
            "steps": 99,
            "curve": [{"step": 9, "seconds": 4.5, "psnr": 21.25}],
            "step_ms": {"project": stage},
            "frame_ms": {"project": stage, "network": stage},
        },
    }
