"""Checkpoints that are no whole files: refused in one line, before memory is taken for them."""

import io
import tracemalloc
import warnings
import zipfile

import numpy as np
import pytest
from support.checkpoints import (
    ONE,
    contents,
    ids,
    refusal,
    settings,
    write_run,
)

from pp_cl.errors import UserError
from pp_cl.files.run_folder import RunFolder
from pp_cl.training.checkpoint import load_run_state


@pytest.fixture
def folder(tmp_path):
    """A run's folder that does not exist yet."""
    return RunFolder(tmp_path / "run")


@pytest.fixture
def config():
    return settings()


def rewritten(path, change):
    """Write the members of a checkpoint anew: change({name: bytes}) -> the same."""
    with zipfile.ZipFile(path) as old:
        members = {entry.filename: old.read(entry) for entry in old.infolist()}
    with zipfile.ZipFile(path, "w") as new:
        for name, data in change(members).items():
            new.writestr(name, data)


def npy(array, **options):
    file = io.BytesIO()
    np.save(file, array, **options)
    return file.getvalue()


def compressed(path):
    with zipfile.ZipFile(path) as old:
        members = {entry.filename: old.read(entry) for entry in old.infolist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
        for name, data in members.items():
            new.writestr(name, data)


def bomb(path):
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("bomb.npy", npy(np.zeros(2**24)))


def claimed(path):
    """4 GiB in the directory, of which there is nothing."""
    data = path.read_bytes()
    place = data.rindex(b"PK\x01\x02")
    size = (2**32 - 2).to_bytes(4, "little") * 2
    path.write_bytes(data[: place + 20] + size + data[place + 28 :])


def twice(path):
    with warnings.catch_warnings(), zipfile.ZipFile(path, "a") as archive:
        warnings.simplefilter("ignore")
        archive.writestr("points.ids.npy", npy(ids(range(40))))


def encrypted(path):
    data = bytearray(path.read_bytes())
    data[data.rindex(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(data)


def with_member(name, data):
    return lambda path: rewritten(path, lambda members: members | {name: data})


def with_header(old, new):
    """Change the text of the opacities' own header, of the same length."""
    assert len(old) == len(new)
    name = "points.opacity.npy"
    return lambda path: rewritten(path, lambda m: m | {name: m[name].replace(old, new)})


FILES = {
    "empty": lambda path: path.write_bytes(b""),
    "text": lambda path: path.write_text("hello"),
    "half": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "an array alone": lambda path: path.write_bytes(npy(np.zeros(5))),
    "an empty zip": lambda path: rewritten(path, lambda members: {}),
    "a readme": with_member("README.txt", b"hello"),
    "a readme that ends like an array": with_member("README.npy", b"hello"),
    "a folder": with_member("points/", b""),
    "a path outside": with_member("../../x.npy", npy(ONE)),
    "a name that leaves the line": with_member("a\n\x1b[2J.npy", npy(ONE)),
    "a pickle": with_member("x.npy", npy(np.array([{}], object), allow_pickle=True)),
    "columns first": with_member("points.sh1.npy", npy(np.asfortranarray(np.ones((40, 3, 16))))),
    "big-endian": with_member("points.opacity.npy", npy(np.zeros(40, ">f4"))),
    "no header": lambda path: rewritten(
        path, lambda m: {name: data for name, data in m.items() if name != "header.npy"}
    ),
    "a header of numbers": with_member("header.npy", npy(np.zeros(5))),
    "fewer values than said": with_header(b"(40,)", b"(41,)"),
    "more values than said": with_header(b"(40,)", b"(39,)"),
    "less than none": with_header(b"(40,)", b"(-4,)"),
    "code": with_header(b"'<f4'", b"f(4) "),
    "python 2": with_header(b"(40,)", b"(4L,)"),
    "brackets": with_header(b"(40,)", b"((((("),
    "compressed": compressed,
    "a bomb": bomb,
    "4 GiB claimed": claimed,
    "an array twice": twice,
    "encrypted": encrypted,
}


@pytest.mark.parametrize("damage", FILES.values(), ids=FILES)
def test_a_file_that_cannot_be_is_refused_before_memory_is_taken(folder, config, damage):
    write_run(folder, config, *contents(config))
    damage(folder.checkpoint)
    refusal(folder, config)  # what is imported on the way is not counted below
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


def mutated(data, rng):
    """A copy with a few random changes, half of them in the directory or an array's header."""
    data = bytearray(data)
    for _ in range(rng.integers(1, 4)):
        marks = (b"PK\x01\x02", b"PK\x03\x04", b"\x93NUMPY", b"PK\x05\x06")
        start = data.find(marks[rng.integers(4)], rng.integers(len(data)))
        place = int(rng.integers(len(data)))
        if start >= 0 and rng.random() < 0.7:
            place = min(start + int(rng.integers(120)), len(data) - 1)
        length = int(rng.integers(1, 40))
        kind = rng.integers(6)
        if kind == 0:
            data[place] ^= 1 << rng.integers(8)
        elif kind == 1:
            data[place] = rng.integers(256)
        elif kind == 2:
            data[place : place + 4] = rng.choice([b"\xff\xff\xff\xff", b"\0\0\0\0", b"\0\0\0\x80"])
        elif kind == 3:
            del data[place : place + length]
        elif kind == 4:
            data[place:place] = data[place : place + length]
        else:
            other = int(rng.integers(len(data)))
            data[place : place + length] = data[other : other + length]
    return bytes(data)


def test_of_random_changes_all_are_refused_or_change_nothing(folder, config):
    header, arrays = contents(config)
    write_run(folder, config, header, arrays)
    whole, refused = folder.checkpoint.read_bytes(), 0
    for seed in range(300):
        folder.checkpoint.write_bytes(mutated(whole, np.random.default_rng(seed)))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                found_header, found = load_run_state(folder, config)
        except UserError as error:
            assert str(error).isprintable() and str(folder.checkpoint) in str(error), seed
            refused += 1
            continue
        assert found_header == {"format": 1, **header} and found.keys() == arrays.keys(), seed
        assert all(np.array_equal(found[name], arrays[name]) for name in arrays), seed
    assert refused > 200
