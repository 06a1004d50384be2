"""Settings: presets, text conversion, JSON round trip, and one-line errors that name the key."""

import json

import pytest

from pp_cl.config import PRESETS, Config, assign, help_lines, load_config, preset, validate
from pp_cl.errors import UserError


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_valid_and_survive_json(name, tmp_path):
    config = preset(name)
    validate(config, "preset")
    (tmp_path / "config.json").write_text(config.to_json())
    assert load_config(tmp_path / "config.json") == config


def test_tiny_is_the_default():
    assert preset("tiny") == Config()


def test_paper_preset_keeps_the_supplementals_numbers():
    paper = preset("paper")
    assert (
        paper.points.count == 4_000_000
        and paper.points.footprint == "disc"
        and paper.points.radius == 0.0015
    )
    assert (
        paper.points.gamma == (0.1, 0.01)
        and paper.points.max_tracked == 64
        and paper.points.stop == 0.001
    )
    assert paper.network.widths == (128, 256, 512) and paper.train.iterations == 50_000
    assert paper.train.sh_rate == (0.5, 0.25, 0.125) and paper.train.sh_rate_decay == 0.1
    assert [d * paper.train.iterations for d in paper.train.sh_delay] == [0, 500, 1000]


@pytest.mark.parametrize(
    "key, text, value",
    [
        ("train.iterations", "1e3", 1000),
        ("points.radius", "0.5", 0.5),
        ("network.widths", "8,16,32", (8, 16, 32)),
        ("train.phases", "false", False),
        ("points.footprint", "disc", "disc"),
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
        ("trains.iterations", "5", "unknown key"),
        ("preset", "x", "unknown key"),
        ("train.iterations", "many", "whole number"),
        ("train.iterations", "1.5", "whole number"),
        ("train.iterations", "inf", "whole number"),
        ("network.widths", "8,16", "3 values"),
        ("network.widths", 8, "3 values"),
        ("train.phases", "perhaps", "true or false"),
        ("points.radius", "nan", "finite number"),
        ("points.gamma", "0.1,x", "finite number"),
    ],
)
def test_assign_refuses(key, text, message):
    with pytest.raises(UserError, match=message) as caught:
        assign(Config(), key, text, "--set")
    assert key in str(caught.value)


@pytest.mark.parametrize(
    "key, value",
    [
        ("train.iterations", 0),
        ("train.crop", 130),
        ("points.footprint", "gauss"),
        ("points.gamma", (0.1, 0.0)),
        ("network.widths", (0, 1, 1)),
        ("train.dropout", 1.0),
        ("points.count", 2**28),
        ("network.rate", (0.0, 0.0)),
    ],
)
def test_validate_refuses(key, value):
    config = Config()
    section, name = key.split(".")
    setattr(getattr(config, section), name, value)
    with pytest.raises(UserError):
        validate(config, "settings")


@pytest.mark.parametrize(
    "text, message",
    [
        ("{", "not JSON"),
        ("[]", "preset"),
        ('{"preset": "tiny", "train": 3}', "train"),
        ('{"preset": "tiny", "train": {"x": 3}}', "train.x"),
    ],
)
def test_broken_config_file_names_file_and_key(tmp_path, text, message):
    path = tmp_path / "config.json"
    path.write_text(text)
    with pytest.raises(UserError, match=message) as caught:
        load_config(path)
    assert str(path) in str(caught.value)


def test_help_covers_every_setting():
    text = "\n".join(help_lines())
    for section, values in json.loads(Config().to_json()).items():
        if isinstance(values, dict):
            for name in values:
                assert f"  {section}.{name} = " in text
