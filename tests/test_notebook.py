import ast
import json
from pathlib import Path

import pytest
from PIL import Image

from pp_cl.files.rendered_view import RenderedView

NOTEBOOK = Path(__file__).parents[1] / "docs" / "tour.ipynb"


@pytest.mark.slow
def test_the_notebook_makes_a_video_and_a_page(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    cells = json.loads(NOTEBOOK.read_text("utf-8"))["cells"]
    sources = ["".join(c["source"]) for c in cells if c["cell_type"] == "code"]
    assert "1500" in sources[0]
    names, shown = {}, []
    for source in sources:
        *body, last = ast.parse(source.replace("1500", "20")).body
        exec(compile(ast.Module(body, []), str(NOTEBOOK), "exec"), names)  # noqa: S102
        if isinstance(last, ast.Expr):  # a notebook shows the value of a last expression
            shown.append(eval(compile(ast.Expression(last.value), str(NOTEBOOK), "eval"), names))  # noqa: S307
        else:
            exec(compile(ast.Module([last], []), str(NOTEBOOK), "exec"), names)  # noqa: S102
    assert isinstance(shown[0], RenderedView) and set(shown[1]) == {"psnr", "ssim"}
    with Image.open(tmp_path / "runs/tour/video.gif") as video:
        assert video.n_frames == 24 and video.size == (200, 200)
    assert (tmp_path / "runs/tour/view.html").stat().st_size > 1e5
