"""The compilers of GPUs: where they are, and Debian's packages of those that are absent.

Packages are unpacked into build/gpu, not installed: that needs no root, and the installed driver of
Intel's GPUs would be one more OpenCL platform. NVIDIA's ptxas and nvdisasm are not free and in none
of them; they are looked for in the PATH, in CUDA's folder and among the Python packages.
"""

import os
import re
import shutil
import subprocess
import sysconfig
from pathlib import Path

FOLDER = Path(__file__).parents[2] / "build" / "gpu"
CUDA = Path("/usr/local/cuda/bin")
LLVM = 19
CLANG, LINKER, PTXAS, OCLOC = f"clang-{LLVM}", f"ld.lld-{LLVM}", "ptxas", "ocloc"
NVDISASM = "nvdisasm"
NVIDIA_LIBRARY, AMD_LIBRARY = "nvptx64--nvidiacl.bc", "amdgcn--amdhsa.bc"
# {program or file: Debian's package of it}
PACKAGES = {
    CLANG: f"clang-{LLVM}",
    NVIDIA_LIBRARY: f"libclc-{LLVM}",
    AMD_LIBRARY: f"libclc-{LLVM}",
    LINKER: f"lld-{LLVM}",
    OCLOC: "intel-opencl-icd",
}
# {program of CUDA's: package of Python that has it}
WHEELS = {PTXAS: "nvidia-cuda-nvcc", NVDISASM: "nvidia-cuda-nvdisasm"}


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


def find(name: str) -> str:
    """The path of a program, or of a file of libclc. Raises CompilerMissing."""
    places, mode = [environment()["PATH"]], os.X_OK
    if name in WHEELS:
        packages = Path(sysconfig.get_path("purelib"), "nvidia")
        places += [str(CUDA), *(str(path.parent) for path in packages.glob(f"*/bin/{name}"))]
    elif name.endswith(".bc"):
        # not /usr/lib/clc, where another version of LLVM may have put its own
        places, mode = [str(FOLDER / "usr" / "lib" / "clc")], os.R_OK
    found = shutil.which(name, mode, os.pathsep.join(places))
    if not found:
        source = (
            f"install CUDA's compiler, or {WHEELS[name]} into .venv by pip"
            if name in WHEELS
            else f"it is in Debian's package {PACKAGES[name]}"
        )
        raise CompilerMissing(f"{name} is missing: {source}")
    return found


def unpack_missing() -> str:
    """Unpack Debian's packages of what is absent. Returns what went wrong, else ""."""
    wanted = {}  # in order, each once
    for name, package in PACKAGES.items():
        try:
            find(name)
        except CompilerMissing:
            wanted[package] = name
    if not wanted:
        return ""
    if not shutil.which("apt-get") or not shutil.which("dpkg"):
        return "no apt-get here, which would fetch the compilers"
    debs = FOLDER / "packages"
    shutil.rmtree(debs, ignore_errors=True)
    debs.mkdir(parents=True)
    try:
        plan = _run("apt-get", "install", "--simulate", "--no-install-recommends", *wanted)
        needed = dict.fromkeys([*wanted, *re.findall(r"(?m)^Inst (\S+)", plan)])
        _run("apt-get", "download", *needed, folder=debs)
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
