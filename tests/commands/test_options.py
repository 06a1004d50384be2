import json
import sys

import numpy as np
import pytest
from support.refused import failure, refusing

from pp_cl.cli import main
from pp_cl.commands import options
from pp_cl.files.image import write_png

REFUSED = [
    (options.integer(1, 16), ("16.5", "0", "17", "x", "nan", "1,2", "9" * 5000)),
    (options.integer(4, 4096, 4), ("30", "-4", "0", "inf")),
    (options.number(0.5, 2), ("0.4", "3", "nan", "1,2", "")),
    (options.several(options.integer(1, 10)), ("1,,2", "1,11")),
    (options.words(options.METRICS), ("beauty", "psnr,beauty", ",")),
    (options.widths, ("1,2", "1,2,x", "0,1,2", "16,16," + "9" * 5000)),
    (options.size, ("0x32", "large", "16", f"{'9' * 5000}x16")),
    (options.output_file(), (".", "/", "..", "no-such/a.json", "/dev/null", "a" * 300)),
    (options.output_file(".png"), ("a.jpg", "png")),
]


@pytest.mark.parametrize("read, texts", REFUSED)
def test_what_an_option_cannot_be_is_refused(read, texts):
    for text in texts:
        with refusing():
            read(text)


def test_texts_become_what_is_meant(tmp_path):
    assert options.integer(1, 10**6)("1e3") == 1000
    assert options.several(options.integer(1, 10**6))("1e3,10,10") == [10, 1000]
    assert options.words(options.METRICS)("psnr, lpips") == ("psnr", "lpips")
    assert options.widths("16,32,48") == (16, 32, 48)
    for text in (str(tmp_path / "new.PNG"), "new.png"):
        assert options.output_file(".png")(text) == text


def test_json_goes_to_a_file_or_in_place_of_the_text(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("pp_cl.drivers.list_devices", lambda **_: [])
    file = tmp_path / "a.json"
    for words in (["--json"], ["--json", "-"], ["--json=-"], ["--json", str(file)]):
        assert main(["devices", *words]) == 2  # no device works
        assert capsys.readouterr().out == ("\n" if str(file) in words else "[]\n")
    assert json.loads(file.read_text()) == []


def test_no_other_file_becomes_json(tmp_path):
    for name in "ab":
        write_png(tmp_path / f"{name}.png", np.zeros((16, 16, 3)))
    images, before = [str(tmp_path / f"{n}.png") for n in "ab"], (tmp_path / "a.png").read_bytes()
    for words in (["--json", *images], [*images, "--json", images[0]]):
        assert "before --json" in failure("compare", *words)
    assert (tmp_path / "a.png").read_bytes() == before


def test_other_output_leaves_printed_json_alone(tmp_path, capsys, monkeypatch):
    def talk(parsed):
        print("measuring", parsed.subject)
        options.write_json_option(parsed.json, {"a": 1})

    monkeypatch.setattr("pp_cl.commands.info.run", talk)
    assert main(["info", str(tmp_path), "--json"]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out) == {"a": 1} and printed.err == f"measuring {tmp_path}\n"
    assert sys.stdout is not sys.stderr


@pytest.mark.parametrize(
    "words",
    [
        ("compare", "a", "b", "--json"),
        ("eval", "a", "--scene"),
        ("info", "a", "--device"),
    ],
)
def test_an_empty_value_is_refused(words, capsys):
    for argv in ((*words, ""), (*words[:-1], f"{words[-1]}=")):
        assert main(argv) == 2
        error = capsys.readouterr().err
        assert f"{words[-1]}: is empty" in error and error.count("\n") == 1


@pytest.mark.parametrize(
    "words, found",
    [
        ("RUN --json", {"subject": "RUN", "truth": None, "json": None}),
        ("RUN --json -", {"json": None}),
        ("A B --json out", {"subject": "A", "truth": "B", "json": "out"}),
        ("--json out RUN", {"subject": "RUN", "json": "out"}),
        ("A B --metrics", {"truth": "B", "metrics": options.METRICS}),
        ("A B --metrics psnr", {"truth": "B", "metrics": ("psnr",)}),
    ],
)
def test_options_whose_value_may_be_left_out(tmp_path, monkeypatch, words, found):
    """Options take the word after them. Without a word, --json prints and --metrics means all."""
    monkeypatch.chdir(tmp_path)
    parsed = {}
    monkeypatch.setattr("pp_cl.commands.compare.run", lambda options: parsed.update(vars(options)))
    assert main(["compare", *words.split()]) == 0
    parsed["json"] = None if parsed["json"] is sys.stdout else parsed["json"]
    assert {name: parsed[name] for name in found} == found


@pytest.mark.parametrize(
    "words", ["info --json RUN", "info --json none", "eval --metrics RUN", "bench --json conv"]
)
def test_it_is_said_how_to_write_what_they_have_taken(tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "RUN").mkdir()
    assert f"before {words.split()[1]}" in failure(*words.split())
