"""Settings: presets, text conversion, JSON round trip, and one-line errors that name the key."""

import json

import pytest

from pp_cl.config import Config, assign, help_lines, load_config, preset, validate
from pp_cl.errors import UserError
from pp_cl.presets import PRESETS, RENAMED


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_valid_and_survive_json(name, tmp_path):
    config = preset(name)
    validate(config, "preset")
    (tmp_path / "config.json").write_text(config.to_json())
    assert load_config(tmp_path / "config.json") == config


@pytest.mark.parametrize("name", PRESETS)
def test_a_key_that_a_stored_run_lacks_has_its_presets_value(name, tmp_path):
    """Unless the key came later: the run had the former behaviour."""
    (tmp_path / "config.json").write_text(json.dumps({"preset": name, "train": {"seed": 3}}))
    expected = preset(name)
    expected.train.seed, expected.train.opacity_rate_steps = 3, 0
    expected.raster.blend, expected.points.opacity = "softmax", 1.0
    expected.train.mask_weight = 0.0
    assert load_config(tmp_path / "config.json") == expected


@pytest.mark.parametrize("old", RENAMED)
def test_an_old_key_sets_the_new_one_and_is_noted(old):
    new = RENAMED[old]
    section, name = new.split(".")
    value = getattr(getattr(preset("paper"), section), name)
    config, expected = Config(), Config()
    assign(config, old, value, "--set")
    assign(expected, new, value, "--set")
    assert config == expected
    assert config.notes == [f"--set: {old} is called {new} now"] and not expected.notes


def test_a_run_with_old_keys_loads_with_one_note(tmp_path):
    stored = json.loads(preset("paper").to_json())
    for old, new in RENAMED.items():
        section, name = new.split(".")
        former, former_name = old.split(".")
        stored[former][former_name] = stored[section].pop(name)
    assert stored.pop("raster") == {"blend": "softmax", "window": "image"}  # without former names
    (tmp_path / "config.json").write_text(json.dumps(stored))
    config = load_config(tmp_path / "config.json")
    assert config == preset("paper")
    (note,) = config.notes
    assert "config.json: points.footprint is called raster.footprint now" in note
    assert f"{len(RENAMED) - 1} other keys" in note


def test_paper_preset_keeps_the_supplementals_numbers():
    """What the supplemental states; the delays in steps hold for our 50,000 iterations."""
    paper = preset("paper")
    assert paper.points.count == 4_000_000 and paper.points.sh_degree == 2
    raster = paper.raster
    assert raster.radius == 0.0015 and raster.gamma == (0.1, 0.01)
    assert raster.max_tracked == 64 and raster.early_stop == 0.001
    assert paper.network.widths == (128, 256, 512)
    assert paper.train.sh_rate == (0.5, 0.25, 0.125) and paper.train.sh_rate_decay == 0.1
    assert [d * paper.train.iterations for d in paper.train.sh_delay] == [0, 500, 1000]


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
        ("trains.iterations", "5", "unknown key"),
        ("preset", "x", "unknown key"),
        ("train.iterations", "many", "whole number"),
        ("train.iterations", "1.5", "whole number"),
        ("train.iterations", "inf", "whole number"),
        ("network.widths", "8,16", "3 values"),
        ("network.widths", 8, "3 values"),
        ("train.pixel_jitter", "perhaps", "true or false"),
        ("raster.radius", "nan", "finite number"),
        ("raster.gamma", "0.1,x", "finite number"),
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
        ("raster.footprint", "gauss"),
        ("network.blocks", "triple"),
        ("raster.gamma", (0.1, 0.0)),
        ("network.widths", (0, 1, 1)),
        ("raster.footprint", ["soft"]),
        ("train.dropout", 1.0),
        ("train.sh_delay", (0.0, 0.0, 1.1)),
        ("points.count", 2**28),
        ("network.rate", (0.0, 0.0)),
    ],
)
def test_validate_refuses(key, value):
    config = Config()
    section, name = key.split(".")
    setattr(getattr(config, section), name, value)
    with pytest.raises(UserError, match=key):
        validate(config, "settings")


@pytest.mark.parametrize(
    "text, message",
    [
        ("{", "not JSON"),
        ("[]", "preset"),
        ('{"preset": ["tiny"]}', "preset"),
        ('{"preset": "huge"}', "preset"),
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
    """With its default as --set takes it."""
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
