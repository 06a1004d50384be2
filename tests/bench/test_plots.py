"""What is drawn, and that matplotlib can draw it."""

from pp_cl.bench.plots import figure_of, plot_models, plot_overview, plot_ranks, save_figure


def network_row(variant, direction, ms, side):
    return {
        "variant": variant, "direction": direction, "ms": ms, "shape": [side], "rel_l2": 0.0
    }  # fmt: skip


def raster_row(points, ms):
    return {
        "size": 200, "blend": "alpha", "points": points, "ms": ms, "ms_range": [ms - 1, ms + 2]
    }  # fmt: skip


RESULT = {
    "unet": [
        network_row("direct", "forward", 9.0, 64),
        network_row("direct", "forward", 2.0, 128),
        network_row("winograd", "train", 3.0, 128),
    ],
    "raster": [raster_row(2000, 8.0), raster_row(1000, 6.0)],
    "training": {
        "curve": [{"step": 9, "seconds": 4.5, "psnr": 21.25}],
        "step_ms": {"project": {"ms": 1.0}, "network": {"ms": 2.0}, "update": {"ms": 3.0}},
        "frame_ms": {"project": {"ms": 0.5}, "network": {"ms": 1.5}},
    },
}


def test_all_benches_are_on_one_picture():
    figure = figure_of("a.png")
    plot_overview(figure, RESULT)
    network, raster, quality, stages = figure.axes
    drawn = {line.get_label(): line.get_xydata().tolist() for line in network.lines}
    assert drawn["direct, forward"] == [[2.0, 1e-9]]  # of the largest image, error 0
    assert drawn["winograd, train"] == [[3.0, 1e-9]] and drawn["direct, train"] == []
    (curve,) = raster.containers
    line, _, (bars,) = curve.lines
    assert line.get_xydata().tolist() == [[1000, 6], [2000, 8]]
    assert [part[:, 1].tolist() for part in bars.get_segments()] == [[5, 8], [7, 10]]
    assert quality.lines[0].get_xydata().tolist() == [[4.5, 21.25]]
    assert [[bar.get_width() for bar in bars] for bars in stages.containers] == [
        [3, 2, 1],
        [1.5, 0.5],
    ]
    names = [label.get_text() for label in stages.get_yticklabels()]
    assert names == ["update", "network", "project"]


def test_matplotlib_draws_them(tmp_path):
    rows = [{"what": what, "speed": 1.0, "loss": 0.1} for what in ("a", "keep 0.5", "keep 0.25")]
    whole, models = tmp_path / "whole.png", tmp_path / "models.svg"
    figure = figure_of(str(whole))
    plot_overview(figure, RESULT)
    save_figure(figure, str(whole))
    figure = figure_of(str(models))
    plot_models(figure.add_subplot(), rows)
    save_figure(figure, str(models))
    assert whole.read_bytes().startswith(b"\x89PNG") and "<svg" in models.read_text()


def test_a_run_alone_has_a_chart_too(tmp_path):
    """Without bars, which exaggerate where they do not begin at 0."""
    chart = tmp_path / "chart.png"
    figure = figure_of(str(chart))
    plot_ranks(figure, ["psnr"], [("runs/mine", {"psnr": 30.0})], "runs/mine")
    save_figure(figure, str(chart))
    (axes,) = figure.axes
    low, high = axes.get_xlim()
    assert low < 30 < high and not axes.patches
