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


def test_all_benches_are_on_one_picture(tmp_path):
    file = tmp_path / "whole.png"
    figure = figure_of(str(file))
    plot_overview(figure, RESULT)
    network, raster, quality, stages = figure.axes
    drawn = {line.get_label(): line.get_xydata().tolist() for line in network.lines}
    assert drawn["direct, forward"] == [[2.0, 1e-9]]  # of the largest image, error 0
    assert drawn["winograd, train"] == [[3.0, 1e-9]] and drawn["direct, train"] == []
    ((line, _, (bars,)),) = raster.containers
    assert line.get_xydata().tolist() == [[1000, 6.0], [2000, 8.0]]
    assert [part[:, 1].tolist() for part in bars.get_segments()] == [[5.0, 8.0], [7.0, 10.0]]
    assert quality.lines[0].get_xydata().tolist() == [[4.5, 21.25]]
    assert [[bar.get_width() for bar in some] for some in stages.containers] == [
        [3, 2, 1], [1.5, 0.5]
    ]  # fmt: skip
    names = [label.get_text() for label in stages.get_yticklabels()]
    assert names == ["update", "network", "project"]
    save_figure(figure, str(file))
    assert file.read_bytes().startswith(b"\x89PNG")


def test_each_way_to_make_a_run_smaller_is_one_series(tmp_path):
    whats = ("a", "keep 0.5", "keep 0.25")
    rows = [{"what": what, "speed": i, "loss": 0.1} for i, what in enumerate(whats)]
    file = tmp_path / "models.svg"
    figure = figure_of(str(file))
    plot_models(figure.add_subplot(), rows)
    drawn = {line.get_label(): list(line.get_xdata()) for line in figure.axes[0].lines}
    assert drawn == {"a": [0], "keep": [1, 2]}
    save_figure(figure, str(file))
    assert "<svg" in file.read_text()


def test_a_bar_alone_is_drawn_without_a_warning(tmp_path, recwarn):
    figure = figure_of(str(tmp_path / "ranks.png"))
    plot_ranks(figure, ["psnr", "lpips"], [("mine", {"psnr": 30.0, "lpips": 0.0})], "mine")
    save_figure(figure, str(tmp_path / "ranks.png"))
    assert not recwarn.list
    assert [axes.get_xlim() for axes in figure.axes] == [(24.0, 31.5), (0.0, 0.05)]
