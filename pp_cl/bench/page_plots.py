"""The plots of the page of `pp-cl bench`; figure: matplotlib's, result: of bench_overview()."""

from __future__ import annotations

from typing import Any

LEAST_ERROR = 1e-9  # an error of 0 has no logarithm: drawn there


def time_and_error(figure: Any, result: dict[str, Any]) -> None:
    """Milliseconds against relative L2 error: of the layers added up, and of the largest network
    measured.
    """
    layers, network = figure.subplots(1, 2)
    names = dict.fromkeys(row["variant"] for row in [*result["conv"], *result["unet"]])
    colours = {name: f"C{i}" for i, name in enumerate(names)}
    for axes, title, points in (
        (layers, "layers", layer_points(result["conv"])),
        (network, "network", network_points(result["unet"])),
    ):
        axes.set(
            xscale="log", yscale="log", xlabel="milliseconds", ylabel="relative L2 error",
            title=title,
        )  # fmt: skip
        for i, (direction, variants) in enumerate(points.items()):
            for variant, (ms, error) in variants.items():
                label, colour = f"{variant}, {direction}", colours[variant]
                axes.plot(ms, error, marker="os^"[i % 3], color=colour, ls="", label=label)
            axes.plot(*zip(*pareto_front(list(variants.values())), strict=True), color="0.6", lw=1)


def layer_points(rows: list[dict]) -> dict[str, dict[str, tuple[float, float]]]:
    """{direction: {variant: (sum of the milliseconds, largest error)}} of the variants that all
    layers of a direction have.
    """
    found = {}
    for direction in dict.fromkeys(row["direction"] for row in rows):
        some = [row for row in rows if row["direction"] == direction]
        layers = {row["layer"] for row in some}
        for variant in dict.fromkeys(row["variant"] for row in some):
            own = [row for row in some if row["variant"] == variant]
            if {row["layer"] for row in own} == layers:
                error = max(LEAST_ERROR, *(row["rel_l2"] for row in own))
                found.setdefault(direction, {})[variant] = sum(row["ms"] for row in own), error
    return found


def network_points(rows: list[dict]) -> dict[str, dict[str, tuple[float, float]]]:
    """{direction: {variant: (milliseconds, error)}} of the largest network."""
    largest, found = max(row["shape"][0] for row in rows), {}
    for row in rows:
        if row["shape"][0] == largest:
            point = row["ms"], max(LEAST_ERROR, row["rel_l2"])
            found.setdefault(row["direction"], {})[row["variant"]] = point
    return found


def pareto_front(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """The points that no other one is as low as in both numbers, ascending in the first."""
    front = []
    for point in sorted(set(points)):
        if not front or point[1] < front[-1][1]:
            front.append(point)
    return front


def stages(figure: Any, result: dict[str, Any]) -> None:
    """A bar each for a training step and a frame, its stages one after the other."""
    axes = figure.add_subplot(xlabel="milliseconds")
    training, colours = result["training"], {}
    for bar, key in (("frame", "frame_ms"), ("training step", "step_ms")):
        left = 0.0
        for name, row in training[key].items():
            is_new = name not in colours
            colour = colours.setdefault(name, f"C{len(colours) % 10}")
            hatch = "//" if list(colours).index(name) >= 10 else None
            axes.barh(
                bar, row["ms"], left=left, color=colour, hatch=hatch, label=name if is_new else None
            )
            left += row["ms"]


def growth(figure: Any, result: dict[str, Any]) -> None:
    """Milliseconds against points, a line for each size, blend and tau."""
    axes = figure.add_subplot(
        xscale="log", yscale="log", xlabel="points", ylabel="milliseconds, forward and backward"
    )
    curves = {}
    for row in result["raster"]:
        curves.setdefault((row["size"], row["blend"], row["tau"]), []).append(row)
    for (size, blend, tau), rows in curves.items():
        rows = sorted(rows, key=lambda row: row["points"])
        points, ms = [row["points"] for row in rows], [row["ms"] for row in rows]
        spread = [[row["ms"] - row["ms_range"][0] for row in rows]]
        spread += [[row["ms_range"][1] - row["ms"] for row in rows]]
        label = f"side {size}, {blend}, tau {tau:g}"
        axes.errorbar(points, ms, yerr=spread, marker="o", capsize=2, label=label)


def psnr(figure: Any, result: dict[str, Any]) -> None:
    """PSNR of the demo against the seconds of its training."""
    axes = figure.add_subplot(xlabel="seconds of training", ylabel="PSNR, dB")
    curve = result["training"]["curve"]
    axes.plot([row["seconds"] for row in curve], [row["psnr"] for row in curve], marker="o")
