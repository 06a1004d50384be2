from support.scenes import write_ball_scene

from pp_cl.session.training import train_scene
from tools import stages as TOOL

SETTINGS = {"points.count": 400, "network.widths": (16, 16, 16), "train.iterations": 4}


def test_stages_of_a_finished_run(tmp_path, monkeypatch):
    monkeypatch.setattr(TOOL, "UNTIMED", 1)
    monkeypatch.setattr(TOOL, "TIMED", 2)
    scene, out = write_ball_scene(tmp_path / "ball"), tmp_path / "run"
    train_scene(scene, out, settings=SETTINGS)
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    measured = TOOL.measure(scene, out, None)
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
    least = {row["stage"]: row.get("least_ms") for row in measured["stages"]}
    assert all(row["ms"] > 0 for row in measured["stages"])
    assert {name for name, ms in least.items() if ms} == {*TOOL.least_bytes(*[1] * 6)} | {
        "network",
        "network backward",
    }
    assert measured["points"] < 500 and measured["copy_gbs"] > 0.1 and measured["gflops"] > 1
