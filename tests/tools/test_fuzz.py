"""The fuzzer finds what is wrong, and nothing is in a few inputs of every surface."""

import json
import struct
import zipfile
from io import BytesIO
from random import Random

import numpy as np
import pytest
from PIL import Image
from support.checkpoints import contents, settings, write_run

from pp_cl.config import preset
from pp_cl.errors import UserError
from pp_cl.files.run_folder import RunFolder
from tools.fuzz import __main__ as fuzz
from tools.fuzz import binary, values, words
from tools.fuzz import runs as run_surfaces
from tools.fuzz.judge import Case, Finding, check_json
from tools.fuzz.templates import World
from tools.fuzz.worker import SURFACES, try_input

COUNT = 50


def drawn(seed):
    return Random(seed)  # noqa: S311  not for secrets


@pytest.fixture
def world(tmp_path, monkeypatch):
    """Templates without runs, which would have to be trained."""
    monkeypatch.setenv("PP_CACHE", str(tmp_path))
    return World(tmp_path)


def test_a_few_inputs_of_every_surface_are_taken_or_refused(capsys):
    assert fuzz.main(["--count", str(COUNT), "--seed", "12"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "0 kinds of findings"
    counts = dict(pair.rsplit(" ", 1) for pair in lines[-2].partition(": ")[2].split(", "))
    assert counts.keys() == SURFACES.keys() and min(map(int, counts.values())) >= 1


def test_names_are_mixed_and_shared_out():
    names = fuzz.names_of(["images", "sweep"], 100)
    assert len(names) == 100 and len(set(names)) == 100
    assert sum(name.startswith("images:") for name in names) == 80
    assert {name.partition(":")[0] for name in names[:10]} == {"images", "sweep"}
    assert sorted(name for name in names if "sweep" in name)[:2] == ["sweep:0", "sweep:1"]


def test_an_input_is_a_function_of_its_name_and_seed(world):
    labels = [try_input(world, "messages:7", seed)[0] for seed in (1, 1, 2)]
    assert labels[0] == labels[1] != labels[2]


@pytest.mark.parametrize(
    "raised, found",
    [
        (KeyError("x"), "KeyError at "),
        (MemoryError(), "MemoryError at "),
        (RecursionError(), "RecursionError at "),
        (UserError("refused"), ""),
        (OSError(5, "Input/output error", "a"), ""),
    ],
)
def test_what_a_reader_raises(world, monkeypatch, raised, found):
    def read(text):
        raise raised

    monkeypatch.setattr(words, "read_request", read)
    assert try_input(world, "messages:1", 0)[1] == found


def test_nonsense_that_is_believed(world, monkeypatch):
    read = words.read_request

    def believing(text):
        request = read('{"kind": "frame"' + text[text.index(",") :])
        object.__setattr__(request, "tau", float("nan"))
        return request

    monkeypatch.setattr(words, "read_request", believing)
    monkeypatch.setattr(words, "changed_json", lambda rng, value, keys: ("", value))
    name = next(n for n in map("messages:{}".format, range(99)) if try_input(world, n, 0)[1])
    assert try_input(world, name, 0)[1] == "accepted: request: tau = nan"


def test_settings_beyond_their_limits_are_nonsense():
    for change in ({"crop": -4}, {"crop": 4.0}, {"opacity_rate": (0.1,)}, {"ema": 1}):
        config = preset("tiny")
        vars(config.train).update(change)
        with pytest.raises(Finding, match=f"accepted: train.{next(iter(change))} = "):
            run_surfaces.check_config(config)
    config.train.opacity_rate = (0.1, float("inf"))
    with pytest.raises(Finding, match="accepted: Infinity in settings"):
        run_surfaces.check_config(config)
    run_surfaces.check_config(preset("tiny"))


def test_a_warning_of_a_library_is_a_finding(world):
    case = Case(drawn(0), world.folder, world)
    with pytest.raises(Finding, match="RuntimeWarning at .*divide by zero"):
        case.read(lambda: np.ones(1) / np.zeros(1))


def test_statuses_and_lines_of_a_command(world, monkeypatch):
    case = Case(drawn(0), world.folder, world)
    assert case.command("eval", world.folder / "none") == 2
    assert case.command("eval", "--help") == 0
    monkeypatch.setattr("tools.fuzz.judge.main", lambda words: 1)
    with pytest.raises(Finding, match="exit status 1"):
        case.command("eval")
    monkeypatch.setattr("tools.fuzz.judge.main", lambda words: 2)
    with pytest.raises(Finding, match="another last line"):
        case.command("eval")


def test_nan_that_was_written(tmp_path):
    (tmp_path / "log.jsonl").write_text('{"psnr": 1}\n{"psnr": NaN}\n')
    with pytest.raises(Finding, match="NaN written"):
        check_json(tmp_path / "log.jsonl")
    (tmp_path / "a.json").write_text('{\n"psnr": 1\n}')
    assert check_json(tmp_path / "a.json") == {"psnr": 1}


def test_a_worker_that_dies_is_a_finding_and_begins_anew(tmp_path):
    worker = fuzz.Worker(0, str(tmp_path), "")
    worker._words = ["sh", "-c", "read x; exit 7"]
    for _ in range(2):
        assert worker.try_input("a:1")["found"] == "crash with exit status 7"
    worker._words = ["sh", "-c", 'read x; echo "{\\"label\\": \\"$x\\"}"; read x']
    assert worker.try_input("a:2") == {"label": "a:2"}
    worker.end()


def test_findings_are_reported_once_a_kind():
    found = {
        "log: KeyError at a.py:1": [("log:3", "x", "trace")] * 2,
        "mesh: hang": [("mesh:1", "", "")],
    }
    text = fuzz.report({"log": 5, "mesh": 2}, found, 3.2, details=False)
    assert text.splitlines() == [
        "2 x log: KeyError at a.py:1",
        "    e.g. --one log:3 (x)",
        "1 x mesh: hang",
        "    e.g. --one mesh:1 ()",
        "7 inputs in 3 s: log 5, mesh 2",
        "2 kinds of findings",
    ]
    assert "trace" in fuzz.report({"log": 5}, found, 1, details=True)


def test_an_unknown_surface(capsys):
    with pytest.raises(SystemExit):
        fuzz.main(["--one", "nothing:3"])
    assert "no surface nothing" in capsys.readouterr().err


# --------------------------------------------------------------------------------------------------


def test_changed_json_is_another_value_at_a_place_that_is_named():
    original = {"a": [1, 2.5, {"b": "x"}], "c": None}
    changed = 0
    for seed in range(200):
        label, value = values.changed_json(drawn(seed), json.loads(json.dumps(original)), ("k",))
        changed += values.dumps(value) != values.dumps(original)
        assert label
    assert changed > 160
    assert values.places({"a": [1]}) == [(), ("a",), ("a", 0)]
    assert values.dumps({"a": [values.Raw("NaN")], "b": "NaN"}) == b'{"a": [NaN], "b": "NaN"}'


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_changed_bytes_texts_and_archives_differ(monkeypatch):
    monkeypatch.setattr(binary, "BOMB", 2**16)
    file = BytesIO()
    np.savez(file, a=np.arange(6.0).reshape(2, 3), b=np.arange(3))
    png = BytesIO()
    Image.new("RGB", (4, 4)).save(png, "PNG")
    for change, data in (
        (binary.changed_bytes, b"some bytes of a file"),
        (values.changed_text, b"1 2 3\n4 5 6\n"),
        (binary.changed_npz, file.getvalue()),
        (binary.changed_png, png.getvalue()),
        (binary.changed_npy, binary.npy(np.arange(4.0))),
    ):
        results = [change(drawn(seed), data)[1] for seed in range(60)]
        assert sum(result != data for result in results) > 50, change.__name__
        assert results == [change(drawn(seed), data)[1] for seed in range(60)]


def test_chunks_come_back_with_right_checksums():
    png = BytesIO()
    Image.new("RGB", (4, 4), (9, 8, 7)).save(png, "PNG")
    parts = binary.chunks(png.getvalue())
    assert [kind for kind, _ in parts] == [b"IHDR", b"IDAT", b"IEND"]
    assert parts[0][1][:8] == struct.pack(">II", 4, 4)
    assert binary.png(parts) == png.getvalue()
    with zipfile.ZipFile(BytesIO(binary.archived([("a", b"b")]))) as archive:
        assert archive.read("a") == b"b"


def test_a_run_with_a_leftover_is_a_finding(tmp_path):
    folder, config = RunFolder(tmp_path / "run"), settings()
    write_run(folder, config, *contents(config))
    folder.log.write_text("")
    run_surfaces.check_run_files(folder.path)
    (folder.path / ".a.12.tmp").touch()
    with pytest.raises(Finding, match="temporary files left"):
        run_surfaces.check_run_files(folder.path)
