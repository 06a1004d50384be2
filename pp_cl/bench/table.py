"""Lines of the printed tables of `pp-cl bench conv`, `bench unet`, the demo's training and
`pp-cl tune`.
"""

from typing import Any

COLUMNS = "{:8} {:26} {:9} {:14} {:>9} {:>8} {:>5} {:>8} {:>8}".format
HEAD = COLUMNS("layer", "shape", "direction", "variant", "ms", "GFLOP/s", "peak", "rel. L2", "max")
STAGE = "{:16} {:>8} {:>8} {:>8} {:>8}".format
TUNE_COLUMNS = "{:7} {:20} {:9} {:68} {:>8}  {}".format
TUNE_HEAD = TUNE_COLUMNS("layer", "shape", "direction", "milliseconds", "rel. L2", "taken")


def line(row: dict) -> str:
    """A row of bench_conv() or bench_unet()."""
    return COLUMNS(
        row["layer"],
        "x".join(map(str, row["shape"])),
        row["direction"],
        row["variant"],
        f"{row['ms']:.3f}",
        f"{row['gflops']:.1f}",
        f"{row['peak_share']:.0%}",
        f"{row['rel_l2']:.1e}",
        f"{row['max_err']:.1e}",
    )


def training_lines(training: dict[str, Any]) -> list[str]:
    """The tables of bench_demo()."""
    lines = ["{:>6} {:>9} {:>7}".format("step", "seconds", "PSNR")]
    lines += [
        f"{row['step']:6d} {row['seconds']:9.1f} {row['psnr']:7.2f}" for row in training["curve"]
    ]
    lines.append(STAGE("stage, ms", "step", "least", "most", "frame"))
    for name, row in training["step_ms"].items():
        frame = training["frame_ms"].get(name)
        numbers = [f"{row[key]:.2f}" for key in ("ms", "least", "most")]
        lines.append(STAGE(name, *numbers, f"{frame['ms']:.2f}" if frame else ""))
    return lines


def tune_line(name: str, row: dict, chosen: str | None, shipped: str) -> str:
    """A row of a tuning. name: of the layer; chosen: the variant within the tolerance, None if no
    variant is exact enough; shipped: the shipped one.
    """
    ms = ", ".join(f"{variant} {ms:.3f}" for variant, ms in row["ms"].items())
    side = round(row["pixels"] ** 0.5)
    shape = f"{side}x{side}x{row['ci']}x{row['co']}x{row['k']}"
    if chosen is None:
        return TUNE_COLUMNS(name, shape, row["direction"], ms, "", "none")
    return TUNE_COLUMNS(
        name,
        shape,
        row["direction"],
        ms,
        f"{row['rel_l2'][chosen]:.1e}",
        chosen if chosen == shipped else f"{chosen} instead of {shipped}",
    )


def blocking_line(field: str, times: dict, chosen: object) -> str:
    """The values of a field of Blocking and their milliseconds."""
    shown = [
        f"{_text(value)} {ms:.2f}{' (taken)' if value == chosen else ''}"
        for value, ms in times.items()
    ]
    return f"blocking of {field}, ms: {', '.join(shown)}"


def _text(value):
    """8/2/1x1x1 of 8, 2, (1, 1, 1)."""
    parts = value if isinstance(value, tuple) else (value,)
    return "/".join("x".join(map(str, p)) if isinstance(p, tuple) else str(p) for p in parts)
