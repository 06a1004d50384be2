"""A user's files in folders that commands write to stay as they are: a command leaves them alone,
or refuses in one line. A full disk leaves nothing half written.
"""

import errno
import os
import shutil
from pathlib import Path

import pytest
from support.runs import arguments, spoken
from support.sweeps import jobs_of, pretend, words_of

from pp_cl.cli import main

VIDEO = ["render", "run", "--seconds", "0.2", "--fps", "10"]
EXPORT = ["export", "run", "--format"]
# Each kind of output has its own way of writing: runs, evaluations, files, folders, pages, tables.
# {name: (words; files named in them, which may be replaced)}
COMMANDS = {
    "train": (None, ()),
    "eval": (["eval", "run", "--save-images"], ()),
    "eval elsewhere": (["eval", "run", "--save-images", "--out", "there"], ()),
    "video elsewhere": ([*VIDEO, "--out", "a.gif"], ("a.gif",)),
    "frames": ([*VIDEO, "--format", "png"], ()),
    "export html": ([*EXPORT, "html"], ()),
    "export ply elsewhere": ([*EXPORT, "ply", "--out", "a.ply"], ("a.ply",)),
    "export scene elsewhere": ([*EXPORT, "scene", "--out", "a"], ()),
    "info": (["info", "run", "--picture", "a.png", "--json", "a.json"], ("a.png", "a.json")),
    "sweep": (None, ()),
}
STATE = ("config.json", "checkpoint.npz", "log.jsonl")  # a run owns files with these names
OLD = 1_000_000_000


@pytest.fixture
def work(finished, tmp_path, monkeypatch):
    shutil.copytree(finished, tmp_path / "run")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def words_for(name, scene):
    if name == "train":
        return arguments(scene, Path("run"))
    if name == "sweep":
        for job in jobs_of([scene], "there"):
            pretend(job, 20.0)
        return words_of([scene], "there")
    return COMMANDS[name][0]


def files(folder):
    """{path: (bytes, time)} of all files in a folder."""
    paths = [path for path in folder.rglob("*") if path.is_file()]
    return {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in paths}


def made(paths, folder):
    for path in paths:
        with path.open("ab") as file:
            file.write(b"mine")
        os.utime(path, (OLD, OLD))
    return {path: there for path, there in files(folder).items() if path in paths}


@pytest.mark.parametrize("name", COMMANDS)
def test_what_is_the_users_stays(work, scene, name, capsys):
    before, words = files(work), words_for(name, scene)
    assert main(words) == 0
    written = files(work)
    folders = {path for path in work.rglob("*") if path.is_dir()} | {work}
    others = ("mine.png", "notes.txt", ".own.txt", "step_999999.png", ".lock", ".a.7.tmp")
    beside = made([folder / other for folder in folders for other in others], work)

    def again(earlier):
        status, lines = spoken(words)
        errors = [line for line in lines if line.startswith("pp-cl: ")]
        assert (status, len(errors)) in ((0, 0), (2, 1)), lines
        assert {path: files(work).get(path) for path in earlier} == earlier

    again(beside)
    new = [path for path, there in written.items() if before.get(path) != there]
    new = [path for path in new if path.name[0] != "." and path.name not in STATE]
    changed = made([path for path in new if path.name not in COMMANDS[name][1]], work)
    assert changed or COMMANDS[name][1] or name == "train"
    again(beside | changed)


def full(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("name", [n for n in COMMANDS if "elsewhere" in n or COMMANDS[n][1]])
def test_a_full_disk_is_one_line_and_nothing_is_left(work, scene, name, monkeypatch):
    words = words_for(name, scene)
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        patch.setattr(os, "replace", full)
        status, lines = spoken(words)
    errors = [line for line in lines if line.startswith("pp-cl: ")]
    assert status == 2 and len(errors) == 1 and "space" in errors[0] and ".tmp" not in errors[0]
    assert not list(work.rglob(".*.tmp*"))
    assert main(words) == 0
