import ast
import configparser
import re
import shutil
import subprocess
import sys
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

from pp_cl import __version__
from pp_cl.errors import UserError
from pp_studio.capture.packages import needed

ROOT = Path(__file__).parents[2]
OURS = ("pp_cl", "pp_studio")
KERNEL_FILES = sorted((ROOT / "cl").rglob("*.cl"))


def test_every_kernel_file_is_launched_by_its_own_wing():
    """tests/selftest/test_perturbed.py checks that it has cases in the selftest."""
    orphans = []
    for path in KERNEL_FILES:
        name = path.relative_to(ROOT / "cl").with_suffix("").as_posix()
        folders = [(ROOT / top / name).parent for top in ("pp_cl/engine", "pp_cl")]
        modules = [module for folder in folders for module in folder.glob("*.py")]
        if not any(f'"{name}"' in module.read_text("utf-8") for module in modules):
            orphans.append(name)
    assert KERNEL_FILES
    assert not orphans


def test_setup_cfg_declares_every_package_that_is_imported():
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg")
    lists = setup["options"]["install_requires"], *setup["options.extras_require"].values()
    declared = {re.split("[<>=;]", line)[0] for text in lists for line in text.split("\n")}
    distributions, names = packages_distributions(), set()
    for path in (p for top in (*OURS, "tests", "tools") for p in (ROOT / top).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name.partition(".")[0] for alias in node.names}
            if isinstance(node, ast.ImportFrom) and not node.level:
                names.add(node.module.partition(".")[0])
    names -= sys.stdlib_module_names | {*OURS, "tests", "tools", "support"}
    packages = {
        name: distributions.get(name, [name])[0].lower().replace("_", "-") for name in names
    }
    assert "numpy" in names
    assert set(packages.values()) <= {name.lower() for name in declared}


def test_commands_that_install_work_in_a_checkout_and_with_the_wheel(monkeypatch):
    """Messages list the packages of an extra, not pp-cl[extra]: pp-cl is on no index, and a message
    cannot know where it was installed from.
    """
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg")
    extras = {
        name: {re.split("[<>=;]", line)[0] for line in lines.split("\n") if line}
        for name, lines in setup["options.extras_require"].items()
    }
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(UserError) as caught:
        needed("pycolmap")
    named = {frozenset(re.search("`pip install (.+)`", str(caught.value))[1].split(" "))}
    for path in (path for top in OURS for path in (ROOT / top).rglob("*.py")):
        text = path.read_text("utf-8")
        named |= {
            frozenset(packages.split(" ")) for packages in re.findall("pip install ([^`{]+)`", text)
        }
        required = re.findall(r'    require\("[^"]+", ([^)]+)\)', text)
        named |= {frozenset(re.findall('"([^"]+)"', packages)) for packages in required}
    for_users = set(extras) - {"cpu", "test", "lint", "torch"}
    assert named == {frozenset(extras[name]) for name in for_users}
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "docs").glob("*.ipynb")]
    assert not [page.name for page in pages if "pp-cl[" in page.read_text("utf-8")]


def test_the_conda_recipe_asks_for_what_setup_cfg_does():
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg")
    wanted = {
        re.sub("^OpenEXR", "openexr-python", line)
        for line in setup["options"]["install_requires"].split()
    }
    text = (ROOT / "packaging/recipe.yaml").read_text("utf-8")
    run = text.partition("  run:\n")[2].partition("\ntests:")[0]
    lines = {line.replace(" ", "") for line in re.findall("(?m)^    - ([a-z-]+ >=.*)$", run)}
    assert wanted == lines - {"python>=3.10", "pocl>=5.0"}
    assert f'version: "{__version__}"' in text


@pytest.mark.unix
def test_lint_installs_no_driver():
    command = ["make", "--always-make", "--dry-run", "lint"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert "setup_venv.sh" in done.stdout and "setup_opencl.py" not in done.stdout


def packed(folder, tmp_path):
    """The files that setuptools packs into a source archive of the folder."""
    command = [sys.executable, "setup.py", "-q", "egg_info", "--egg-base", str(tmp_path)]
    subprocess.run(command, cwd=folder, capture_output=True, check=True)
    return set((tmp_path / "pp_cl.egg-info" / "SOURCES.txt").read_text("utf-8").splitlines())


def test_the_source_archive_lacks_what_is_not_free(tmp_path):
    """Images of other authors' scenes are under CC BY-NC-SA, as their pages say."""
    files = packed(ROOT, tmp_path)
    assert {"docs/capture.png", "cl/common.h", "pp_cl/engine/step.py"} <= files
    assert not {"docs/orbits.png", "docs/make.png"} & files


def test_docker_gets_all_that_is_installed(tmp_path):
    lines = (ROOT / ".dockerignore").read_text("utf-8").splitlines()
    nothing, *names, last = [line for line in lines if line[0] != "#"]
    assert (nothing, last) == ("*", "**/__pycache__")
    for path in (ROOT / name.removeprefix("!") for name in names):
        copy = shutil.copytree if path.is_dir() else shutil.copy
        copy(path, tmp_path / path.name)
    expected = {
        name for name in packed(ROOT, tmp_path) if name.startswith(("cl/", "pp_cl/", "pp_studio/"))
    }
    expected |= {"LICENSE", "README.md", "pyproject.toml", "setup.cfg", "setup.py"}
    shutil.rmtree(tmp_path / "pp_cl.egg-info")
    assert expected <= packed(tmp_path, tmp_path)


# {folder: words that meant several things; docs/glossary.md has those that took their places}
GONE = {"cl": r"\bSIDE\b", "pp_cl/engine/raster": r"\bside\b", "pp_cl/scene": r"\bscene\.found\b"}


@pytest.mark.parametrize("folder", GONE)
def test_words_that_meant_several_things_do_not_come_back(folder):
    files = [path for path in (ROOT / folder).rglob("*") if path.suffix in (".cl", ".h", ".py")]
    assert files
    assert not [str(f) for f in files if re.search(GONE[folder], f.read_text("utf-8"))]
