"""tools/gpu/packages.py: compilers are found, fetched where they are absent, and named where they
cannot be.
"""

import pytest

from tools.gpu import packages
from tools.gpu.packages import CompilerMissing, environment, find, unpack_missing

APT = """#!/bin/sh
echo "apt-get $@" >> "$LOG"
case "$1" in
install) printf 'Reading\\nInst libone (1 Debian)\\nInst two [1] (2 Debian)\\nConf two\\n' ;;
download) touch a_1.deb b_2.deb ;;
esac
"""
DPKG = """#!/bin/sh
mkdir -p "$3/usr/bin" "$3/usr/lib/x86_64-linux-gnu" "$3/usr/lib/clc"
touch "$3/usr/lib/clc/nvptx64--nvidiacl.bc" "$3/usr/lib/clc/amdgcn--amdhsa.bc"
for program in clang-19 ld.lld-19 ocloc; do
    echo '#!/bin/sh' > "$3/usr/bin/$program"
    chmod +x "$3/usr/bin/$program"
done
"""


@pytest.fixture
def bare(tmp_path, monkeypatch):
    """A machine without compilers. Returns the folder of its programs."""
    programs = tmp_path / "bin"
    programs.mkdir()
    for name in ("sh", "mkdir", "chmod", "touch"):
        (programs / name).symlink_to(f"/bin/{name}")
    monkeypatch.setenv("PATH", str(programs))
    monkeypatch.setenv("LOG", str(tmp_path / "log"))
    monkeypatch.setattr(packages, "FOLDER", tmp_path / "gpu")
    monkeypatch.setattr(packages, "CUDA", tmp_path / "none")
    return programs


def program(folder, name, text):
    """Write a program."""
    path = folder / name
    path.write_text(text)
    path.chmod(0o755)
    return str(path)


def test_it_fetches_what_is_absent_once(bare, tmp_path):
    program(bare, "apt-get", APT)
    program(bare, "dpkg", DPKG)
    assert unpack_missing() == ""
    assert (tmp_path / "log").read_text().splitlines() == [
        "apt-get install --simulate --no-install-recommends"
        " clang-19 libclc-19 lld-19 intel-opencl-icd",
        "apt-get download clang-19 libclc-19 lld-19 intel-opencl-icd libone two",
    ]
    assert find("ocloc") == str(tmp_path / "gpu" / "usr" / "bin" / "ocloc")
    assert not (tmp_path / "gpu" / "packages").exists()
    assert str(tmp_path / "gpu/usr/lib/x86_64-linux-gnu") in environment()["LD_LIBRARY_PATH"]
    assert unpack_missing() == ""
    assert len((tmp_path / "log").read_text().splitlines()) == 2


def test_without_apt_get_it_says_so(bare):
    assert unpack_missing() == "no apt-get here, which would fetch the compilers"
    with pytest.raises(CompilerMissing, match="^ocloc is missing: .* intel-opencl-icd$"):
        find("ocloc")


def test_what_apt_get_said_is_passed_on(bare):
    program(bare, "apt-get", "#!/bin/sh\necho 'E: no such package' >&2\nexit 100\n")
    program(bare, "dpkg", DPKG)
    assert "(E: no such package); apt-get update may help" in unpack_missing()


def test_ptxas_of_a_python_package(bare, tmp_path, monkeypatch):
    monkeypatch.setattr(packages.sysconfig, "get_path", lambda name: str(tmp_path / "site"))
    with pytest.raises(CompilerMissing, match="^ptxas is missing: install CUDA's compiler"):
        find("ptxas")
    folder = tmp_path / "site" / "nvidia" / "cu13" / "bin"
    folder.mkdir(parents=True)
    placed = program(folder, "ptxas", "#!/bin/sh\n")
    assert find("ptxas") == placed


def test_libclc(bare, tmp_path, monkeypatch):
    monkeypatch.setitem(packages.PACKAGES, "none.bc", "libnone")
    with pytest.raises(CompilerMissing, match="^none.bc is missing: .* libnone$"):
        find("none.bc")
    folder = tmp_path / "gpu" / "usr" / "lib" / "clc"
    folder.mkdir(parents=True)
    (folder / "none.bc").touch()
    assert find("none.bc") == str(folder / "none.bc")
