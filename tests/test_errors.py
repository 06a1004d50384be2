import pytest

from pp_cl.errors import MOST_LINE, Stopped, UserError, quoted, require, shown


def test_packages_that_are_missing_are_named_with_what_installs_them():
    require("a test", "numpy")
    with pytest.raises(UserError, match="a test needs numpy and no-such; .*install numpy no-such`"):
        require("a test", "numpy", "no-such")


@pytest.mark.parametrize("broken", ["raise OSError('no lib.so')", "import not_there"])
def test_packages_that_cannot_be_imported_are_told_alike(tmp_path, monkeypatch, broken):
    (tmp_path / "broken_one.py").write_text(broken)
    monkeypatch.syspath_prepend(tmp_path)
    told = r"a test needs broken-one \(broken-one cannot be imported: .*(no lib|not_there).*\); ins"
    with pytest.raises(UserError, match=told):
        require("a test", "broken-one")


def test_what_has_no_end_is_named_by_its_kind():
    deep = []
    for _ in range(100_000):
        deep = [deep]
    assert quoted(deep) == "a list"
    assert shown("\ud800") == "?"
    assert len(quoted(10**5000)) <= 100  # Python 3.10 may print such numbers


def test_every_message_is_one_line():
    line = "a b?[31m??"
    assert str(UserError("a\u2028b\x1b[31m\0\ud800")) == line
    stopped = Stopped("a\nb", 143)
    assert str(stopped) == "a b" and stopped.status == 143


def test_a_long_message_keeps_its_file_and_its_mend():
    message = str(UserError(f"a.json: {'x' * 10**6}; copy it again"))
    assert len(message) == MOST_LINE
    assert message.startswith("a.json: xxx") and message.endswith("xxx; copy it again")
    assert str(UserError(message)) == message
    assert str(UserError("x" * MOST_LINE)) == "x" * MOST_LINE
