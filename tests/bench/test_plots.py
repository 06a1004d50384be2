"""What is drawn."""

from pp_cl.bench.plots import figure_of, plot_time_and_error, save_figure


def network_row(variant, direction, ms, error):
    return {"bench": "unet", "variant": variant, "direction": direction, "ms": ms} | {
        "rel_l2": error, "max_err": 1.0
    }  # fmt: skip


ROWS = [
    network_row("direct", "forward", 9.0, 1e-6),
    network_row("direct", "forward", 2.0, 0.0),
    network_row("winograd", "train", 3.0, 1e-5),
    {"bench": "raster", "blend": "alpha", "ms": 8.0, "max_err": 1e-7},
    {"bench": "train", "blend": "alpha", "ms": 8.0},  # has no error
]


def test_time_against_error(tmp_path):
    file = tmp_path / "a.svg"
    figure = figure_of(str(file))
    plot_time_and_error(figure, ROWS)
    (axes,) = figure.axes
    assert {line.get_label(): line.get_xydata().tolist() for line in axes.lines} == {
        "unet direct, forward": [[9.0, 1e-6], [2.0, 1e-9]],
        "unet winograd, train": [[3.0, 1e-5]],
        "raster, alpha": [[8.0, 1e-7]],
    }
    assert len({line.get_color() for line in axes.lines}) == 3
    save_figure(figure, str(file))
    assert "<svg" in file.read_text()
