"""Invented measurements of convolutions."""

from pp_cl.layers.choice import FORMAT, device_key

MS = {"direct": 1.0, "winograd": 2.0}
REL_L2 = {"direct": 2e-7, "winograd": 5e-7}


def row(pixels=64 * 64, ms=MS, rel_l2=REL_L2, direction="forward", k=3, ci=64, co=32):
    """A row of a tuning."""
    return {
        "direction": direction,
        "k": k,
        "ci": ci,
        "co": co,
        "pixels": pixels,
        "ms": ms,
        "rel_l2": rel_l2,
    }


def tuning_of(dev, rows=(), blocking=()):
    """A tuning of this device."""
    return {
        "format": FORMAT,
        "device": device_key(dev),
        "tile_shapes": dict(blocking),
        "rows": list(rows),
    }
