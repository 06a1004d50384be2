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

from pp_cl.files.run_folder import RunFolder


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
