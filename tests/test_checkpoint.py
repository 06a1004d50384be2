import io
import shutil
import tracemalloc
import zipfile

import numpy as np
import pytest
from support.checkpoints import (
    HEADER,
    ONE,
    STEP,
    STEPS,
    contents,
    header_text,
    ids,
    load_checkpoint,
    refusal,
    settings,
    write_run,
)
from support.refused import failure
from support.runs import arguments, train_and_interrupt

from pp_cl.checkpoint import (
    FORMAT,
    check_finite,
    load_run_state,
    opened_run,
    save_checkpoint,
)
from pp_cl.config import load_config
from pp_cl.engine.device.buffers import DeviceRows
from pp_cl.engine.stored import stored_table
from pp_cl.engine.training.exposure import decided_at
from pp_cl.errors import Diverged, UserError
from pp_cl.files.run_folder import RunFolder


@pytest.fixture
def folder(tmp_path):
    return RunFolder(tmp_path / "run")


@pytest.fixture
def config():
    return settings()


def rewritten(path, change, form=zipfile.ZIP_STORED):
    with zipfile.ZipFile(path) as old:
        members = {zip_info.filename: old.read(zip_info) for zip_info in old.infolist()}
    with zipfile.ZipFile(path, "w", form) as new:
        for name, data in change(members).items():
            new.writestr(name, data)


def npy(array, **options):
    file = io.BytesIO()
    np.save(file, array, **options)
    return file.getvalue()


SOME = {
    "points.ids": np.arange(5, dtype=np.uint32),
    "points.opacity": np.linspace(0, 1, 5, dtype=np.float32),
}


def test_equal_content_gives_equal_bytes(dev, tmp_path):
    """Arrays written in pieces give the same bytes. tests/test_properties.py tests that they come
    back.
    """
    rows = {name: DeviceRows(dev, dev.upload(array)) for name, array in SOME.items()}
    for name, arrays in (("a", SOME), ("b", SOME), ("c", rows)):
        save_checkpoint(tmp_path / f"{name}.npz", {"step": 3}, arrays)
    assert len({path.read_bytes() for path in tmp_path.iterdir()}) == 1
    with zipfile.ZipFile(tmp_path / "a.npz") as stored:  # zlib's bytes could change with a version
        assert {zip_info.compress_type for zip_info in stored.infolist()} == {zipfile.ZIP_STORED}


def test_forms_and_single_arrays_are_read_without_the_others(folder, config):
    header, arrays = contents(config)
    write_run(folder, config, header, arrays)
    data = bytearray(folder.checkpoint.read_bytes())
    data[data.index(arrays["points.sh2"].tobytes())] ^= 1  # reading this array would fail
    folder.checkpoint.write_bytes(data)
    with opened_run(folder, config) as stored:
        assert stored.header["step"] == STEP
        assert {n: (f.shape, f.dtype) for n, f in stored.forms.items()} == {
            name: (array.shape, array.dtype) for name, array in arrays.items()
        }
        np.testing.assert_array_equal(stored.array("points.ids"), arrays["points.ids"])
        with pytest.raises(UserError, match=r"npz: cannot be read as a checkpoint \(Bad CRC"):
            stored.array("points.sh2")
    folder.checkpoint.unlink()
    with pytest.raises(UserError, match="no such checkpoint"), opened_run(folder, config):
        pass


def test_a_header_that_could_not_be_read_is_not_written(tmp_path, monkeypatch):
    monkeypatch.setattr("pp_cl.checkpoint.MOST_HEADER", 100)
    save_checkpoint(tmp_path / "a.npz", {"step": 3}, SOME)
    before = (tmp_path / "a.npz").read_bytes()
    with pytest.raises(UserError, match="a.npz: its header"):
        save_checkpoint(tmp_path / "a.npz", {"views": "x" * 100}, SOME)
    assert (tmp_path / "a.npz").read_bytes() == before


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_never_written(tmp_path, value):
    path = tmp_path / "checkpoint.npz"
    save_checkpoint(path, {"step": 1}, SOME)
    before = path.read_bytes()
    broken = {"whole": np.arange(3), "broken": np.array([[0, value]], np.float32)}
    with pytest.raises(Diverged, match="^broken holds NaN or Inf$"):
        save_checkpoint(path, {"step": 2}, broken)
    assert path.read_bytes() == before and [path] == list(tmp_path.iterdir())
    with pytest.raises(Diverged, match="^broken holds"):
        check_finite(broken)
    check_finite(SOME)


@pytest.mark.parametrize("step", [1, STEP, 51, 59, STEPS])
def test_what_fits_is_read_as_it_was_written(folder, config, step):
    header, arrays = contents(config, step)
    write_run(folder, config, header, arrays)
    loaded_header, loaded = load_run_state(folder, load_config(folder.config))
    assert loaded_header == {"format": FORMAT, **header} and loaded.keys() == arrays.keys()
    for name, array in arrays.items():
        assert loaded[name].dtype == (np.float32 if array.dtype == np.float16 else array.dtype)
        np.testing.assert_array_equal(loaded[name], array)


@pytest.mark.parametrize(
    "every, changes",
    [
        (10, {"points__sh_degree": 1, "network__widths": "16,24,40"}),
        (53, {"train__ema": "false", "train__exposure": "off", "network__blocks": "gated"}),
        (30, {"points__sh_degree": 0}),  # the run has not decided on gains yet
        (53, {"train__refine_at": "0.5,1", "downscale": 1}),  # the averages have begun
    ],
)
def test_a_training_writes_what_is_expected(scene, tmp_path, monkeypatch, every, changes):
    folder = RunFolder(tmp_path / "run")
    changes = {"points__count": 300, "train__checkpoint_every": every, **changes}
    train_and_interrupt(scene, folder.path, 58, monkeypatch, **changes)
    header, arrays = load_checkpoint(folder.checkpoint)
    assert header["step"] == {10: 50, 53: 53, 30: 30}[every]
    config, n = load_config(folder.config), len(arrays["points.ids"])
    undecided = config.train.exposure == "auto" and header["step"] < decided_at(0, 8)
    expected = stored_table(config, n, header["step"], gains=8 if undecided else 0)
    assert {name: (a.shape, a.dtype) for name, a in arrays.items()} == expected
    load_run_state(folder, config)
    config.train.iterations = header["step"] + 1  # as a plan by minutes may decide later
    load_run_state(folder, config)


HEADERS = {
    "far before near": {"depth_range": [6.0, 2.0]},
    "depth of NaN": {"depth_range": [2.0, float("nan")]},
    "no vertices": {"grid": HEADER["grid"] | {"dims": [9, 8, 0]}},
    "more vertices than ids": {"grid": HEADER["grid"] | {"dims": [2**20, 2**20, 2]}},
    "step as a text": {"step": "50"},
    "step past the end": {"step": 10**9},
    "finished of 1": {"finished": 1},
    "extended from a step to come": {"extended_from": STEP + 1},
    "a view left out that it never had": {"left_out": ["nobody"]},
    "all views left out": {"left_out": [name for name, _ in HEADER["views"]]},
    "fewer points at the start than now": {"initial_points": 4},
    "views of nothing": {"views": []},
    "a camera of zeros": {"views": [["r_0.png", "A" * 192]]},
    "an unknown key": {"col\nour\x1b[31m": 1},
    "another format": {"format": FORMAT - 1},
}


@pytest.mark.parametrize("change", HEADERS.values(), ids=HEADERS)
def test_a_header_that_no_training_writes_is_refused(folder, config, change):
    header, arrays = contents(config)
    write_run(folder, config, header | change, arrays)
    refusal(folder, config)


@pytest.mark.parametrize("text", [b"[]", b"", b"\xff\xfe{}", header_text()[:80], b"[" * 10**5])
def test_a_header_of_other_text_is_refused(folder, config, text):
    write_run(folder, config, *contents(config))
    header = npy(np.frombuffer(text, np.uint8))
    rewritten(folder.checkpoint, lambda members: members | {"header.npy": header})
    refusal(folder, config)


ARRAYS = {
    "ids reversed": ("points.ids", lambda a: a[::-1].copy(), "ascending order"),
    "ids equal": ("points.ids", lambda a: np.full_like(a, 7), "ascending order"),
    "ids outside": ("points.ids", lambda a: np.append(a[:-1], ids(9 * 8 * 7)), "vertices"),
    "ids in two columns": ("points.ids", lambda a: a.reshape(20, 2), "expected 1 to 50 points"),
    "no points": ("points.ids", lambda a: a[:0], "expected 1 to 50 points"),
    "no ids": ("points.ids", None, "points.ids is missing"),
    "opacity of NaN": ("points.opacity", lambda a: a * np.float32("nan"), "NaN or Inf"),
    "colours of doubles": ("points.sh1", lambda a: a.astype(float), "float64 (40, 3, 16)"),
    "no degree 2": ("points.sh2", None, "points.sh2 is missing, expected float32 (40, 5, 16)"),
    "moments of fewer": ("state.v.sh", lambda a: a[1:], "state.v.sh is float32 (39, 16)"),
    "an average too early": ("average.out.bias", ONE, "holds average.out.bias"),
    "texts": ("net.out.bias", lambda a: np.array(["x"] * 16), "net.out.bias is <U1"),
}


@pytest.mark.parametrize("name, change, told", ARRAYS.values(), ids=ARRAYS)
def test_an_array_that_cannot_be_is_refused(folder, config, name, change, told):
    header, arrays = contents(config)
    if change is None:
        del arrays[name]
    else:
        arrays[name] = change(arrays[name]) if callable(change) else change
    write_run(folder, config, header, arrays)
    assert told in refusal(folder, config)


def test_a_finished_run_holds_no_state_and_an_unfinished_one_does(folder, config):
    whole, model = contents(config)[1], contents(config, STEPS)[1]
    write_run(folder, config, contents(config, STEPS)[0], whole)
    assert "which does not belong" in refusal(folder, config)
    write_run(folder, config, contents(config)[0], model)
    assert "is missing" in refusal(folder, config)
    header, arrays = contents(config, 55)
    del arrays["average.out.bias"]  # averages have begun, so it is required
    write_run(folder, config, header, arrays)
    assert "average.out.bias is missing" in refusal(folder, config)
    del header["grid"]
    write_run(folder, config, header, arrays)
    assert "its header lacks grid" in refusal(folder, config)


def test_coefficients_of_a_finished_run_are_rounded_and_of_no_other(folder, config):
    header, arrays = contents(config, STEPS)
    names = [name for name in arrays if name.startswith("points.sh")]
    rng = np.random.default_rng(8)
    coefficients = {name: rng.normal(0, 3, arrays[name].shape).astype(np.float32) for name in names}
    write_run(folder, config, header, arrays | coefficients)
    stored, loaded = load_checkpoint(folder.checkpoint)[1], load_run_state(folder, config)[1]
    assert len(names) == 3
    for name in names:
        assert stored[name].dtype == np.float16 and loaded[name].dtype == np.float32
        np.testing.assert_array_equal(loaded[name], coefficients[name].astype(np.float16))
    large = arrays | {names[0]: np.full_like(coefficients[names[0]], 1e5)}
    with pytest.raises(Diverged, match="points.sh0 holds NaN or Inf"):
        save_checkpoint(folder.checkpoint, header, large)
    header, arrays = contents(config)
    write_run(folder, config, header, arrays | {"points.sh1": arrays["points.sh1"] * 0.1})
    np.testing.assert_array_equal(
        load_run_state(folder, config)[1]["points.sh1"], arrays["points.sh1"] * np.float32(0.1)
    )
    arrays |= {name: arrays[name].astype(np.float16) for name in names}
    write_run(folder, config, header, arrays)
    assert "points.sh0 is float16" in refusal(folder, config)


def bomb(path):
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("bomb.npy", npy(np.zeros(2**24)))


def claimed(path):
    """Claim 4 GiB in the zip's directory for a member that does not have them."""
    data = path.read_bytes()
    place = data.rindex(b"PK\x01\x02")
    size = (2**32 - 2).to_bytes(4, "little") * 2
    path.write_bytes(data[: place + 20] + size + data[place + 28 :])


def with_member(name, data):
    return lambda path: rewritten(path, lambda members: members | {name: data})


FILES = {
    "half": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "a pickle": with_member("x.npy", npy(np.array([{}], object), allow_pickle=True)),
    "a header of numbers": with_member("header.npy", npy(np.zeros(5))),
    "fewer values than said": with_member("net.out.bias.npy", npy(np.zeros(16))[:-8]),
    "a bomb": bomb,
    "4 GiB claimed": claimed,
}


@pytest.mark.parametrize("damage", FILES.values(), ids=FILES)
def test_a_file_that_cannot_be_is_refused_before_memory_is_taken(folder, config, damage):
    write_run(folder, config, *contents(config))
    damage(folder.checkpoint)
    refusal(folder, config)  # imports happen here, and are not counted below
    tracemalloc.start()
    try:
        refusal(folder, config)
        assert tracemalloc.get_traced_memory()[1] < 2**21
    finally:
        tracemalloc.stop()


def test_a_file_that_may_not_be_read_is_not_called_corrupt(folder, config, monkeypatch):
    write_run(folder, config, *contents(config))

    def refused(*_args, **_named):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(zipfile, "ZipFile", refused)
    line = refusal(folder, config)
    assert "cannot be read (Permission denied)" in line and "delete" not in line


def test_a_training_does_not_go_on_from_it(scene, tmp_path, monkeypatch):
    """tests/commands/test_refused.py tests the other commands on a run that cannot be read."""
    train_and_interrupt(scene, tmp_path / "run", 25, monkeypatch)
    file = tmp_path / "run" / "checkpoint.npz"
    header, arrays = load_checkpoint(file)
    header.pop("format")
    save_checkpoint(file, header, arrays | {"points.ids": arrays["points.ids"][::-1].copy()})
    error = failure(*arguments(scene, tmp_path / "run"))
    assert error.startswith(f"pp-cl: {file}: points.ids must be vertices of its grid in ascending")


def overflow(path):
    header, arrays = load_checkpoint(path)
    header.pop("format")
    for name, array in arrays.items():
        if name.startswith("net.") and name.endswith("weight"):
            array[...] = np.where(np.arange(array.size).reshape(array.shape) % 2, 1e30, -1e30)
    save_checkpoint(path, header, arrays)


@pytest.mark.parametrize(
    "words",
    [
        ["eval"],
        ["render", "--out", "frames", "--format", "png", "--seconds", "0.1", "--size", "24x24"],
        ["export", "--format", "ply", "--out", "a.ply"],
        ["export", "--format", "scene", "--out", "views"],
    ],
)
def test_finite_weights_that_overflow_are_one_line(finished, tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(finished, "run")
    overflow(tmp_path / "run" / "checkpoint.npz")
    error = failure(words[0], "run", *words[1:])
    assert "run/checkpoint.npz: its parameters are so large that the image holds NaN" in error
