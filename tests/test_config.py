import json

import pytest

from pp_cl.config import (
    ADDED,
    assign,
    configure,
    help_lines,
    load_config,
    preset,
    run_config,
    validate,
)
from pp_cl.engine.training import schedule
from pp_cl.errors import UserError
from pp_cl.files.run_folder import RunFolder
from pp_cl.presets import PRESETS
from pp_cl.settings import Config


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_valid_and_survive_json(name, tmp_path):
    config = preset(name)
    config.scene.path = "demo"
    validate(config, "preset")
    (tmp_path / "config.json").write_text(config.to_json())
    assert load_config(tmp_path / "config.json") == config


def test_paper_preset_keeps_the_supplementals_numbers():
    """The numbers that the supplemental states; delays in steps hold for our 50,000 iterations."""
    paper = preset("paper")
    assert paper.points.count == 4_000_000 and paper.points.sh_degree == 2
    raster = paper.raster
    assert raster.radius == 0.0015 and schedule.GAMMA == (0.1, 0.01)
    assert raster.max_tracked == 64 and raster.early_stop == 0.001
    assert paper.network.widths == (128, 256, 512)
    assert paper.train.sh_rate == (0.5, 0.25, 0.125) and schedule.SH_DECAY == 0.1
    assert [d * paper.train.iterations for d in schedule.SH_DELAY] == [0, 500, 1000]


@pytest.mark.parametrize(
    "key, text, value",
    [
        ("train.iterations", "1e3", 1000),
        ("raster.radius", "0.5", 0.5),
        ("network.widths", "8,16,32", (8, 16, 32)),
        ("train.pixel_jitter", "false", False),
        ("raster.footprint", "disc", "disc"),
    ],
)
def test_assign_converts_text(key, text, value):
    config = Config()
    assign(config, key, text, "--set")
    section, name = key.split(".")
    assert getattr(getattr(config, section), name) == value


@pytest.mark.parametrize(
    "key, text, message",
    [
        ("train.iteration", "5", "unknown key"),
        ("train.iterations", "many", "whole number"),
        ("train.iterations", "1.5", "whole number"),
        ("network.widths", "8,16", "3 values"),
        ("train.pixel_jitter", "perhaps", "true or false"),
        ("raster.radius", "nan", "finite number"),
        ("network.rate", "0.1,x", "finite number"),
        ("scene.masks", "a\0b", "word"),
    ],
)
def test_assign_refuses(key, text, message):
    with pytest.raises(UserError, match=message) as caught:
        assign(Config(), key, text, "--set")
    assert key in str(caught.value)


def refusal(path):
    with pytest.raises(UserError) as caught:
        load_config(path)
    line = str(caught.value)
    assert line.startswith(f"{path}: ") and line.isprintable() and len(line) < 400
    return line


TEXTS = {
    "half": b"{",
    "deep": b"[" * 100_000,
    "a list": b"[]",
    "large": b" " * 2**20 + b"{}",
    "nothing in it": b"{}",
    "a list for the preset": b'{"format": 1, "preset": ["tiny"]}',
    "an unknown preset": b'{"format": 1, "preset": "huge"}',
    "a number for a section": b'{"format": 1, "preset": "tiny", "train": 3}',
    "out of line": b'{"format": 1, "preset": "tiny", "a\\nb\\u001b[31m": {}}',
}


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_a_broken_config_file_is_one_line(tmp_path, text):
    (tmp_path / "config.json").write_bytes(text)
    refusal(tmp_path / "config.json")


def stored_settings():
    config = preset("tiny")
    config.scene.path = "demo"
    return json.loads(config.to_json())


VALUES = {
    "format": [5, 0, True, "1", None],
    "decisions": [[], 3, None, {"no.key": "why"}, {"train.ema": 4}, {"train.ema": ["why"]}],
    "train.iterations": [True, "60", 60.5, 10**400, None, 0],
    "train.ema": [1, "true"],
    "train.smooth_l1": [float("nan"), float("inf")],
    "raster.radius": [False, [1.0]],
    "network.rate": ["0.1,0.01", [0.1], [0.1, True]],
    "network.widths": [{"0": 16}, [0, 1, 1]],
    "raster.blend": ["fog", 3, ["alpha"]],
    "train.refine_at": [[0.0, 1.1]],
    "points.count": [2**28],
    "scene.path": ["", "a\0b", "\ud800", "x" * 10**5],
    "scene.masks": [["a"]],
    "points.colour": [3],
}


@pytest.mark.parametrize("key", VALUES)
def test_a_stored_value_of_another_kind_is_refused(tmp_path, key):
    path, (section, _, name) = tmp_path / "config.json", key.partition(".")
    for value in VALUES[key]:
        stored = stored_settings()
        if name:
            stored[section][name] = value
        else:
            stored[section] = value
        path.write_text(json.dumps(stored))
        assert key in refusal(path)


def test_reasons_are_one_line_and_keys_of_older_runs_are_read(tmp_path):
    path, stored = tmp_path / "config.json", stored_settings()
    path.write_text(json.dumps(stored | {"decisions": {"train.ema": "a\x1b[31m\n" * 10**3}}))
    (why,) = load_config(path).decisions.values()
    assert why.isprintable() and len(why) <= 1000
    del stored["decisions"]
    path.write_text(json.dumps(stored | {"automatic": ["train.refine_at"]}))
    assert [*load_config(path).decisions] == ["train.refine_at"]
    for broken in (7, None, "train.refine_at", [["a"]], ["no.key"]):
        path.write_text(json.dumps(stored | {"automatic": broken}))
        assert "decisions are" in refusal(path)


@pytest.mark.parametrize("section", ["scene", "points", "raster", "network", "train"])
def test_a_section_and_each_of_its_keys_must_be_there(tmp_path, section):
    path = tmp_path / "config.json"
    for name in stored_settings()[section]:
        stored = stored_settings()
        del stored[section][name]
        path.write_text(json.dumps(stored))
        if (key := f"{section}.{name}") in ADDED:
            assert getattr(getattr(load_config(path), section), name) == ADDED[key]
        else:
            assert f"{key} is missing" in refusal(path)
    stored = stored_settings()
    del stored[section]
    path.write_text(json.dumps(stored))
    assert f"{section}." in refusal(path)


def test_help_covers_every_setting():
    text, count = "\n".join(help_lines()), 0
    for section, values in json.loads(Config().to_json()).items():
        if isinstance(values, dict):
            for name in values:
                assert f"  {section}.{name} = " in text
                count += 1
    assert count == len(help_lines()) > 30
    config = preset("paper")
    for line in help_lines():
        key, _, rest = line.strip().partition(" = ")
        assign(config, key, rest.partition("  (")[0], "--help")
    assert config == Config(preset="paper")


def test_masks_in_the_folder_of_a_scene_move_with_it(tmp_path):
    here, there = tmp_path / "here", tmp_path / "there"
    config = configure(preset("tiny"), here, [("scene.masks", here / "masks", "--masks")])
    assert configure(config, there).scene.masks == str(there / "masks")
    config = configure(config, there, [("scene.masks", tmp_path / "masks", "--masks")])
    assert configure(config, here).scene.masks == str(tmp_path / "masks")


def test_a_training_that_begins_again_writes_the_same_settings(scene, tmp_path):
    """The training was stopped before its first checkpoint; 0 minutes stay 0."""
    folder, given = RunFolder(tmp_path), [("train.iterations", "30", "--iterations")]
    written = run_config(folder, scene, None, given).to_json()
    folder.configure(written)
    assert run_config(folder, scene, None, given).to_json() == written
