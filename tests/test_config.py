"""Settings: presets, text conversion, JSON round trip, and one-line errors that name the key."""

import json
import os
import re

import numpy as np
import pytest

from pp_cl.config import Config, assign, configure, help_lines, load_config, preset, validate
from pp_cl.errors import UserError
from pp_cl.network.layers import convolutions, unet_layers
from pp_cl.presets import PRESETS


def test_the_scene_is_said_once():
    with pytest.raises(UserError, match="^--set: scene.path is what SCENE"):
        configure(
            preset("tiny"), "demo", [("train.crop", "8", "--set"), ("scene.path", "x", "--set")]
        )


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_valid_and_survive_json(name, tmp_path):
    config = preset(name)
    config.scene.path = "demo"
    validate(config, "preset")
    (tmp_path / "config.json").write_text(config.to_json())
    assert load_config(tmp_path / "config.json") == config


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
        ("scene.masks", "a\0b", "is not a word"),
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


TEXTS = {
    "half": (b"{", "not JSON"),
    "nothing": (b"", "not JSON"),
    "no UTF-8": (b'{"format": 1, "preset": "\xff"}', "not JSON"),
    "deep": (b"[" * 100_000, "not JSON"),
    "5000 digits": (b'{"format": 1, "preset": ' + b"9" * 5000 + b"}", "not JSON"),
    "a list": (b"[]", "not settings"),
    "null": (b"null", "not settings"),
    "large": (b" " * 2**20 + b"{}", "larger than 1048576 bytes"),
    "nothing in it": (b"{}", "format"),
    "a list for the preset": (b'{"format": 1, "preset": ["tiny"]}', "preset"),
    "an unknown preset": (b'{"format": 1, "preset": "huge"}', "preset"),
    "no more than a preset": (b'{"format": 1, "preset": "tiny"}', "key network.blocks is missing"),
    "a number for a section": (
        b'{"format": 1, "preset": "tiny", "train": 3}',
        "train is not an object",
    ),
    "an unknown key": (
        b'{"format": 1, "preset": "tiny", "train": {"x": 3}}',
        "unknown key train.x",
    ),
    "an unknown section": (
        b'{"format": 1, "preset": "tiny", "trains": {}}',
        "trains is no section",
    ),
    "out of line": (
        b'{"format": 1, "preset": "tiny", "a\\nb\\u001b[31m": {}}',
        r"a b\?\[31m is no section",
    ),
}


def refusal(path):
    """The one line by which the settings are refused."""
    with pytest.raises(UserError) as caught:
        load_config(path)
    line = str(caught.value)
    assert line.startswith(f"{path}: ") and line.isprintable() and len(line) < 400
    return line


@pytest.mark.parametrize("text, told", TEXTS.values(), ids=TEXTS)
def test_broken_config_file_names_file_and_key(tmp_path, text, told):
    (tmp_path / "config.json").write_bytes(text)
    assert re.search(told, refusal(tmp_path / "config.json"))


def stored_settings():
    """What a run of the demo stores."""
    config = preset("tiny")
    config.scene.path = "demo"
    return json.loads(config.to_json())


VALUES = [
    ("format", 5, "format is 5, this version reads 1"),
    ("format", 0, "format is 0"),
    ("format", True, "format is True"),
    ("format", "1", "format is '1'"),
    ("format", None, "format is None"),
    ("train.iterations", True, "train.iterations is True, not a whole number"),
    ("train.iterations", "60", "train.iterations is '60', not a whole number"),
    ("train.iterations", 60.5, "train.iterations: 60.5 is not a whole number"),
    ("train.iterations", 10**400, "is not a whole number"),
    ("train.iterations", None, "train.iterations is None"),
    ("train.iterations", 0, "train.iterations = 0"),
    ("train.crop", 130, "train.crop = 130"),
    ("train.ema", 1, "train.ema is 1, not true or false"),
    ("train.ema", "true", "train.ema is 'true', not true or false"),
    ("train.dropout", float("nan"), "train.dropout: nan is not a finite number"),
    ("train.dropout", float("inf"), "train.dropout: inf is not a finite number"),
    ("raster.radius", False, "raster.radius is False, not a finite number"),
    ("raster.radius", [1.0], "raster.radius is [1.0]"),
    ("raster.gamma", "0.1,0.01", "raster.gamma is '0.1,0.01', not 2 values"),
    ("raster.gamma", [0.1], "is not 2 values"),
    ("raster.gamma", [0.1, True], "raster.gamma is True, not a finite number"),
    ("network.widths", {"0": 16}, "network.widths is {'0': 16}, not 3 values"),
    ("raster.blend", "fog", "raster.blend = 'fog'; choose from softmax, alpha"),
    ("raster.blend", 3, "raster.blend is 3, not a word"),
    ("scene.path", "", "scene.path is empty"),
    ("scene.path", "a\0b", r"scene.path is 'a\x00b', no text"),
    ("scene.path", "\ud800", r"scene.path is '\ud800', no text"),
    ("scene.path", "x" * 10**5, "no text"),
    ("scene.masks", ["a"], "scene.masks is ['a'], not a word"),
    ("points.count", [[[]]], "points.count is [[[]]]"),
    ("points.colour", 3, "unknown key points.colour"),
]


@pytest.mark.parametrize("key, value, told", VALUES)
def test_a_stored_value_of_another_kind_is_refused(tmp_path, key, value, told):
    stored, path = stored_settings(), tmp_path / "config.json"
    section, _, name = key.partition(".")
    if name:
        stored[section][name] = value
    else:
        stored[section] = value
    path.write_text(json.dumps(stored))
    assert told in refusal(path)


@pytest.mark.parametrize("section", ["scene", "points", "raster", "network", "train"])
def test_a_section_and_each_of_its_keys_must_be_there(tmp_path, section):
    path = tmp_path / "config.json"
    for name in stored_settings()[section]:
        stored = stored_settings()
        del stored[section][name]
        path.write_text(json.dumps(stored))
        assert f"key {section}.{name} is missing" in refusal(path)
    stored = stored_settings()
    del stored[section]
    path.write_text(json.dumps(stored))
    assert f"key {section}." in refusal(path)


def test_an_old_key_beside_a_format_number_is_refused(tmp_path):
    stored, path = stored_settings(), tmp_path / "config.json"
    stored["train"]["average"] = stored["train"].pop("ema")
    path.write_text(json.dumps(stored))
    assert "unknown key train.average" in refusal(path)


def test_names_of_files_that_are_no_text_survive(tmp_path):
    """A system may give bytes that are no UTF-8."""
    stored, path = stored_settings(), tmp_path / "config.json"
    stored["scene"]["path"] = os.fsdecode(b"/data/\xe4\xff")
    path.write_text(json.dumps(stored))
    assert os.fsencode(load_config(path).scene.path) == b"/data/\xe4\xff"


def test_random_changes_are_refused_in_one_line_or_allowed_settings(tmp_path):
    whole, path, refused = json.dumps(stored_settings(), indent=1).encode(), tmp_path / "c.json", 0
    for seed in range(300):
        rng, data = np.random.default_rng(seed), bytearray(whole)
        for _ in range(rng.integers(1, 4)):
            place, other = (int(n) for n in rng.integers(len(data), size=2))
            kind, length = rng.integers(4), int(rng.integers(1, 30))
            if kind == 0:
                data[place] = rng.integers(256)
            elif kind == 1:
                del data[place : place + length]
            elif kind == 2:
                data[place:place] = data[other : other + length]
            else:
                data[place : place + 1] = rng.choice([b"NaN", b"1e999", b"true", b"[", b'"', b"-"])
        path.write_bytes(data)
        try:
            config = load_config(path)
        except UserError as error:
            assert str(error).startswith(f"{path}: ") and str(error).isprintable(), seed
            refused += 1
            continue
        validate(config, "settings")
        assert json.loads(config.to_json()).keys() == stored_settings().keys()
    assert refused > 200


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


@pytest.mark.parametrize(
    "blocks, channels, count",
    [
        ("double", "16,16", 12),
        ("double", ",".join(["16"] * 11 + ["0"]), 12),
        ("double", ",".join(["16"] * 11 + ["-3"]), 12),
        ("double", ",".join(["16"] * 11 + ["1e3"]), 12),
        ("single", ",".join(["16"] * 12), 7),
        ("gated", "16,", 7),
    ],
)
def test_channels_are_those_of_the_convolutions(blocks, channels, count):
    config = preset("tiny")
    assign(config, "network.blocks", blocks, "test")
    assign(config, "network.channels", channels, "test")
    with pytest.raises(UserError, match=rf"network.channels = .* must be {count} numbers from 1"):
        validate(config, "test")
    assign(config, "network.channels", ",".join(["48"] * count), "test")
    validate(config, "test")
    assert config.network.channel_numbers == (48,) * count
    layers = unet_layers((16, 16, 16), blocks=blocks, channels=config.network.channel_numbers)
    assert len(convolutions(layers)) == count + 1
