import re
from pathlib import Path

from pp_cl.engine import PointCloud, Trainer

PAGE = Path(__file__).parents[2] / "docs" / "api.md"


def test_the_documented_script_trains_from_arrays(tmp_path, monkeypatch, session_device, capsys):
    (script,) = re.findall(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("pp_cl.open_device", lambda: session_device, raising=False)
    names = {}
    exec(compile(script, PAGE, "exec"), names)  # noqa: S102 ours
    assert isinstance(names["trainer"], Trainer) and isinstance(names["points"], PointCloud)
    assert 1000 < names["points"].count < 9000  # of 25^3 vertices, 4189 lie in the ball
    assert names["error"] < 0.03
    assert f"mean error {names['error']:.3f}" in capsys.readouterr().out
    assert not list(tmp_path.iterdir())
