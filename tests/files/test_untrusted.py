import errno
import os
from zipfile import BadZipFile, ZipFile

import pytest

from pp_cl.files.untrusted import (
    MOST_REASON,
    opened_regular,
    opened_zip,
    read_json_text,
    read_regular,
    refusal,
)


def test_a_file_of_at_most_so_many_bytes(tmp_path):
    file = tmp_path / "a.txt"
    file.write_bytes(b"\xef\xbb\xbf" + "gr\u00fc\u00df".encode())
    assert read_regular(file, 9) == "\ufeffgr\u00fc\u00df"
    assert read_regular(str(file), 9, "utf-8-sig") == "gr\u00fc\u00df"
    with pytest.raises(ValueError, match="larger than 8 bytes"):
        read_regular(file, 8)
    with opened_regular(file) as opened:
        assert opened.read(3) == b"\xef\xbb\xbf" and opened.seek(0) == 0


def test_json_of_at_most_so_many_values(tmp_path, monkeypatch):
    """Values in memory are larger than their text: in transforms, camera paths and metrics."""
    monkeypatch.setattr("pp_cl.files.untrusted.MOST_VALUES", 6)
    (tmp_path / "a.json").write_text("[{},[],[]]")
    assert read_json_text(tmp_path / "a.json", 99) == "[{},[],[]]"
    (tmp_path / "a.json").write_text("[{},[],[],[]]")
    with pytest.raises(ValueError, match="more than 6 values"):
        read_json_text(tmp_path / "a.json", 99)


def test_a_zip_of_a_bounded_directory(tmp_path, monkeypatch):
    with ZipFile(tmp_path / "a.zip", "w") as archive:
        for i in range(9):
            archive.writestr(str(i), b"")
    with opened_zip(tmp_path / "a.zip") as archive:
        assert len(archive.namelist()) == 9
    monkeypatch.setattr("pp_cl.files.untrusted.MOST_DIRECTORY", 9 * 46)
    with pytest.raises(ValueError, match="directory is larger"), opened_zip(tmp_path / "a.zip"):
        pass


@pytest.mark.unix
def test_what_is_no_file_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path, "/dev/zero"):
        with pytest.raises(OSError, match="Not a regular file") as caught:
            read_regular(path, 100)
        assert caught.value.errno == errno.ENOTSUP
    with pytest.raises(FileNotFoundError):
        read_regular(tmp_path / "none", 100)


def test_windows_is_told_not_to_translate_line_ends(tmp_path, monkeypatch):
    (tmp_path / "file").write_bytes(b"a\r\n\x1a")
    flags, real = [], os.open
    monkeypatch.setattr(os, "O_BINARY", 1 << 15, raising=False)
    monkeypatch.setattr(os, "open", lambda path, *args: flags.extend(args) or real(path, 0))
    assert read_regular(tmp_path / "file", 9) == "a\r\n\x1a"
    assert flags[0] & os.O_BINARY


def test_the_mend_fits_the_reason():
    denied = PermissionError(errno.EACCES, "Permission denied", "a.png")
    assert str(refusal("a.png", denied, "PNG")) == (
        "a.png: cannot be read (Permission denied); check its permissions and the disk"
    )
    assert str(refusal("a.png", OSError("image file is truncated"), "PNG")) == (
        "a.png: cannot be read as PNG (image file is truncated); copy it again"
    )
    broken = BadZipFile("two\nlines " + "x" * 500)
    message = str(refusal("a.npz", broken, "arrays", "write it again"))
    assert message.startswith("a.npz: cannot be read as arrays (two lines xxx")
    assert message.endswith("...); write it again") and len(message) < MOST_REASON + 60
    assert "(EOFError)" in str(refusal("a", EOFError(), "JSON"))
    beyond = OSError(errno.EOVERFLOW, "Value too large for defined data type")
    assert str(refusal("a.bin", beyond, "COLMAP's")).endswith("copy it again")


def test_texts_of_windows(tmp_path):
    file = tmp_path / "a.json"
    for encoding in ("utf-16", "utf-8"):
        file.write_text('"caf\u00e9"', encoding=encoding)
        assert read_json_text(file, 1000) == '"caf\u00e9"'
    file.write_text('"caf\u00e9"', encoding="cp1252")
    with pytest.raises(UnicodeDecodeError) as caught:
        read_json_text(file, 1000)
    assert str(refusal(file, caught.value, "JSON")).endswith("save it as UTF-8, or copy it again")
