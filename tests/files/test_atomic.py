import errno
import os
import stat
from pathlib import Path

import pytest

from pp_cl.errors import UserError
from pp_cl.files.atomic import (
    MANIFEST,
    atomic_file,
    atomic_folder,
    check_ours,
    is_owned,
    ours,
    own,
    remove_leftovers,
    remove_ours,
    write_json,
    write_text,
)

DEAD = 2**22 + 1  # no process has this number: Linux has none above 2^22


def failing_folder_sync(monkeypatch, number):
    fsync = os.fsync

    def syncing(descriptor):
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(number, os.strerror(number))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", syncing)


@pytest.mark.parametrize("number", [errno.EINVAL, errno.ENOTSUP, errno.EACCES])
def test_a_file_system_that_cannot_sync_folders_still_takes_files(tmp_path, monkeypatch, number):
    failing_folder_sync(monkeypatch, number)
    write_text(tmp_path / "a", "text")
    assert (tmp_path / "a").read_text() == "text"


@pytest.mark.unix
@pytest.mark.parametrize("number", [errno.EIO, errno.ENOSPC])
def test_a_disk_that_fails_to_sync_a_folder_is_told(tmp_path, monkeypatch, number):
    failing_folder_sync(monkeypatch, number)
    with pytest.raises(UserError, match=f"a: cannot be written .{os.strerror(number)}"):
        write_text(tmp_path / "a", "text")


def test_a_temporary_file_that_stays_hides_no_error(tmp_path, monkeypatch):
    def unlink(self, missing_ok=False):
        raise OSError(errno.EIO, "Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", unlink)
        patch.setattr(os, "replace", lambda *_: unlink(None))
        with pytest.raises(UserError, match="a: cannot be written"):
            write_text(tmp_path / "a", "text")
        with pytest.raises(ZeroDivisionError), atomic_file(tmp_path / "b"):
            raise ZeroDivisionError
    assert all(path.name.startswith(".") for path in tmp_path.iterdir())


def test_a_name_that_is_no_utf_8_is_written_escaped(tmp_path):
    write_text(tmp_path / "a.md", "a scene \udcff")
    assert (tmp_path / "a.md").read_text("utf-8") == "a scene \\udcff"


def test_leftovers_below_a_folder_go_and_other_files_stay(tmp_path):
    own = "pp-cl.tmp"
    gone = [f".a.png.{DEAD}.{own}", f"x/y/.b.{DEAD}.{own}", f"x/.video.{DEAD}.{own}.mp4"]
    gone.append(f".own.{os.getpid()}.{own}")  # left by another process that had our number
    staying = [f".{own}", f".a.{own}", f".a.b.{own}", f"a.{DEAD}.{own}", f".a.{DEAD}.{own}file"]
    staying += ["x/log.jsonl", f".a.{DEAD}.tmp"]  # a file of another program
    staying += [f".a.{os.getppid()}.{own}"] * (os.name == "posix")  # our parent still writes it
    for name in gone + staying:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("half")
    (tmp_path / f".link.{DEAD}.{own}").symlink_to(tmp_path / "x")  # its target must keep its files
    folder = tmp_path / "x" / f".page.{DEAD}.pp-cl.tmp"
    folder.mkdir()
    (folder / "index.html").write_text("half")
    remove_leftovers(tmp_path)
    files_left = {p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*") if p.is_file()}
    assert files_left == set(staying) and not folder.exists()


def test_windows_waits_for_a_reader_and_replaces_no_folder(tmp_path, monkeypatch):
    """Windows refuses to rename over a file that another process reads, and over folders."""
    refusals, real = [1, 1], os.replace

    def replace(source, target):
        if Path(target).is_dir() or (refusals and refusals.pop()):
            raise PermissionError(errno.EACCES, "Access is denied", str(target))
        real(source, target)

    monkeypatch.setattr(os, "replace", replace)
    monkeypatch.setattr("sys.platform", "win32")
    write_text(tmp_path / "a", "text")
    assert (tmp_path / "a").read_text() == "text" and not refusals
    (tmp_path / "folder").mkdir()
    with atomic_folder(tmp_path / "folder") as folder:
        (folder / "b").touch()
    assert [path.name for path in (tmp_path / "folder").iterdir()] == ["b"]
    refusals[:] = [1] * 99
    monkeypatch.setattr("pp_cl.files.atomic.READER_SECONDS", 0.2)
    with pytest.raises(UserError, match="cannot be written"):
        write_text(tmp_path / "a", "other")


def test_json_never_holds_nan(tmp_path):
    with pytest.raises(ValueError, match="JSON compliant"):
        write_json(tmp_path / "a.json", {"x": float("nan")})
    assert not (tmp_path / "a.json").exists()


def test_what_was_written_is_ours_until_somebody_changes_it(tmp_path):
    filled = tmp_path / "filled"
    own(filled)
    (filled / "a" / "b").mkdir(parents=True)
    written = [filled / "x.txt", filled / "a" / "b" / "y.txt", filled / "gone.txt"]
    for path in (*written, tmp_path / "beside.txt"):
        write_text(path, path.name)
    with atomic_folder(filled / "z") as folder:
        (folder / "inside").mkdir()
        write_text(folder / "inside" / "1.txt", "one")
        write_text(folder / "2.txt", "two")
    written += [filled / "z" / "inside" / "1.txt", filled / "z" / "2.txt"]
    (filled / "mine.txt").write_text("mine")
    (filled / "link.txt").symlink_to("x.txt")
    others = [filled / "mine.txt", filled / "link.txt", tmp_path / "beside.txt", filled / "none"]
    assert ours([*others, *written]) == written
    written.pop(2).unlink()
    written[0].write_text("changed")
    assert ours(written) == written[1:]
    with pytest.raises(UserError, match=r"x.txt: pp-cl did not write this, .*; put it elsewhere"):
        check_ours(written, "put it elsewhere")
    write_text(written[0], "new")
    check_ours([*written, filled / "none"])
    remove_ours([*written, *others])
    assert not any(path.exists() for path in written)
    assert {path.name for path in filled.iterdir()} == {"mine.txt", "link.txt", MANIFEST}


def test_a_manifest_whose_last_line_was_cut_by_a_kill_goes_on(tmp_path):
    own(tmp_path)
    write_text(tmp_path / "a", "a")
    manifest = tmp_path / MANIFEST
    with manifest.open("ab") as file:
        file.write(b'\n["b", "0123')
    write_text(tmp_path / "c", "c")
    assert ours([tmp_path / "a", tmp_path / "b", tmp_path / "c"]) == [
        tmp_path / "a",
        tmp_path / "c",
    ]


def test_a_folder_becomes_ours_only_where_nothing_would_be_lost(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="file: is not a folder"):
        own(tmp_path / "file")
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "a.txt").write_text("mine")
    (foreign / f".a.{DEAD}.pp-cl.tmp").touch()
    with pytest.raises(UserError, match="foreign: holds other files"):
        own(foreign, alone=True)
    with pytest.raises(UserError, match=r"a\.txt: pp-cl did not write this"):
        own(foreign, [foreign / "a.txt"])
    assert not is_owned(foreign) and len(list(foreign.iterdir())) == 2
    tried = tmp_path / f".foreign.{DEAD}.pp-cl.tmp"  # by a process that could not remove it
    tried.touch()
    own(foreign, [foreign / "b.txt"])
    assert not tried.exists()
    assert is_owned(foreign) and {p.name for p in foreign.iterdir()} == {"a.txt", MANIFEST}
    write_text(foreign / "b.txt", "ours")
    own(foreign, [foreign / "b.txt"], alone=True)
    assert ours(foreign.iterdir()) == [foreign / "b.txt"]
