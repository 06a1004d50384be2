"""The compilers of GPUs: where they are, and Debian's packages of those that are absent.

Packages are unpacked into build/gpu, not installed: that needs no root, and the installed driver of
Intel's GPUs would be one more OpenCL platform. NVIDIA's ptxas is not free and in none of them; it
is looked for in the PATH, in CUDA's folder and among the Python packages.
"""

import os
import re
import shutil
import subprocess
import sysconfig
from pathlib import Path

FOLDER = Path(__file__).parents[2] / "build" / "gpu"
LLVM = 19
# {program: the packages that it needs}
PACKAGES = {
    f"clang-{LLVM}": (f"clang-{LLVM}", f"libclc-{LLVM}"),
    f"ld.lld-{LLVM}": (f"lld-{LLVM}",),
    "ocloc": ("intel-opencl-icd",),
}
PTXAS = "ptxas"


class CompilerMissing(Exception):
    """Which compiler there is not, and how to come by it."""


def environment() -> dict[str, str]:
    """In which the unpacked programs find their libraries and each other."""
    libraries = [str(path) for path in sorted((FOLDER / "usr" / "lib").glob("*-linux-gnu"))]
    programs = [os.environ["PATH"], str(FOLDER / "usr" / "bin")]
    given = [os.environ[name] for name in ("LD_LIBRARY_PATH",) if os.environ.get(name)]
    return {
        **os.environ,
        "PATH": os.pathsep.join(programs),
        "LD_LIBRARY_PATH": os.pathsep.join(given + libraries),
    }


def find(program: str) -> str:
    """The path of a program. Raises CompilerMissing."""
    places = [environment()["PATH"]]
    if program == PTXAS:
        packages = Path(sysconfig.get_path("purelib"), "nvidia")
        places += ["/usr/local/cuda/bin", *(str(p.parent) for p in packages.glob("*/bin/ptxas"))]
    found = shutil.which(program, path=os.pathsep.join(places))
    if not found:
        source = (
            "install CUDA's compiler, or nvidia-cuda-nvcc into .venv by pip"
            if program == PTXAS
            else f"needs Debian's packages {', '.join(PACKAGES[program])}"
        )
        raise CompilerMissing(f"{program} is missing: {source}")
    return found


def library(name: str) -> Path:
    """A file of libclc. Raises CompilerMissing."""
    places = (FOLDER / "usr" / "lib" / "clc" / name, Path("/usr/lib/clc") / name)
    for path in places:
        if path.is_file():
            return path
    raise CompilerMissing(f"{name} is missing: needs Debian's package libclc-{LLVM}")


def unpack_missing() -> str:
    """Unpack Debian's packages of the programs that are absent; what went wrong, else ""."""
    wanted = []
    for program, packages in PACKAGES.items():
        try:
            find(program)
        except CompilerMissing:
            wanted += packages
    if not wanted:
        return ""
    if not shutil.which("apt-get") or not shutil.which("dpkg"):
        return "no apt-get here, which would fetch the compilers"
    debs = FOLDER / "packages"
    shutil.rmtree(debs, ignore_errors=True)
    debs.mkdir(parents=True)
    try:
        plan = _run("apt-get", "install", "--simulate", "--no-install-recommends", *wanted)
        _run("apt-get", "download", *re.findall(r"(?m)^Inst (\S+)", plan), folder=debs)
        for deb in sorted(debs.glob("*.deb")):
            _run("dpkg", "-x", str(deb), str(FOLDER))
    except subprocess.CalledProcessError as error:
        said = (error.stderr.strip().splitlines() or ["no reason given"])[-1]
        return f"{' '.join(error.cmd[:2])} failed ({said}); apt-get update may help"
    shutil.rmtree(debs)
    return ""


def _run(*command, folder=None):
    """What a command prints."""
    path = shutil.which(command[0])
    ran = subprocess.run(
        [path, *command[1:]], cwd=folder, capture_output=True, text=True, check=True
    )
    return ran.stdout
