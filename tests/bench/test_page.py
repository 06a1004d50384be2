"""The page of all benches: numbers and pictures."""

import base64
import re
import sys
from html.parser import HTMLParser

import pytest
from support.bench_results import network_row, result

from pp_cl.bench.page import GROWTH, LAYERS, RASTER, page_text
from pp_cl.bench.page_plots import layer_points, network_points, pareto_front


class Cells(HTMLParser):
    """The texts of the cells, and the addresses of everything that is loaded."""

    def __init__(self, text):
        super().__init__()
        self.cells, self.loaded, self._inside = [], [], False
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self._inside = tag == "td"
        self.loaded += [v for k, v in attributes if k in ("src", "href")]

    def handle_endtag(self, tag):
        self._inside = False

    def handle_data(self, data):
        if self._inside:
            self.cells.append(data)


def leaves(value):
    """All numbers of a result."""
    if isinstance(value, dict):
        value = value.values()
    elif not isinstance(value, list):
        return [value] if isinstance(value, int | float) else []
    return [leaf for item in value for leaf in leaves(item)]


@pytest.fixture(params=["with pictures", "without matplotlib"])
def pictures(request, monkeypatch):
    """Whether the page has pictures."""
    if request.param == "without matplotlib":
        monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
        return False
    pytest.importorskip("matplotlib", reason="the pictures need the extra `plot`")
    return True


def test_every_number_is_one_of_the_result(pictures):
    found = result()
    page = Cells(page_text(found))
    numbers = leaves(found)
    texts = [t for cell in page.cells for t in re.findall(r"[-+]?\d[\d.]*(?:e[-+]\d+)?", cell)]
    forms = ("{}", "{:.0f}", "{:.1f}", "{:.2f}", "{:.1e}", "{:g}")
    known = {form.format(number) for number in numbers for form in forms}
    known |= {"1.2", "0.1.0", "0."}  # the driver, the version, of enc0.a
    assert len(texts) > 60 and set(texts) <= known


def test_pictures_are_inside_and_nothing_is_loaded(pictures):
    text = page_text(result())
    page = Cells(text)
    assert len(page.loaded) == (4 if pictures else 0)
    assert text.count("pip install &#x27;pp-cl[plot]&#x27;") == 4 - len(page.loaded)
    for address in page.loaded:
        kind, _, data = address.partition(";base64,")
        assert kind == "data:image/svg+xml" and b"<svg" in base64.b64decode(data)
    assert "http" not in text and "<script" not in text
    assert "A &lt;device&gt; &amp; more" in text and "<device>" not in text


def test_columns_are_of_the_rows():
    found = result()
    for columns, row in (
        (LAYERS, found["conv"][0]),
        (RASTER, found["raster"][0]),
        (GROWTH, found["growth"][0]),
    ):
        assert {key for _, key, _ in columns} <= set(row)


def test_the_front_is_what_nothing_beats_in_both():
    points = [(3.0, 1.0), (1.0, 5.0), (2.0, 5.0), (2.0, 2.0), (4.0, 1.0), (5.0, 0.5), (3.0, 1.0)]
    assert pareto_front(points) == [(1.0, 5.0), (2.0, 2.0), (3.0, 1.0), (5.0, 0.5)]


def test_layers_are_added_up_where_a_variant_has_them_all():
    rows = [
        network_row("direct", "forward", 2.0, layer="a", rel_l2=1e-7),
        network_row("direct", "forward", 3.0, layer="b", rel_l2=4e-7),
        network_row("winograd", "forward", 1.0, layer="a"),
        network_row("direct", "input", 5.0, layer="a", rel_l2=0.0),
    ]
    assert layer_points(rows) == {
        "forward": {"direct": (5.0, 4e-7)},
        "input": {"direct": (5.0, 1e-9)},
    }


def test_the_largest_network_is_drawn():
    rows = [
        network_row("direct", "train", 2.0),
        network_row("direct", "train", 8.0, shape=[128, 128, 16]),
    ]
    assert network_points(rows) == {"train": {"direct": (8.0, 1.5e-7)}}
