"""Compile and link every kernel as for GPUs, without a GPU.

    python -m tools.gpu_check                      # or make gpu-check
    python -m tools.gpu_check --targets sm_80,pvc  # other GPUs: sm_*, gfx*, or a name ocloc knows

The selftest and two short trainings run on the device at hand in the form for GPUs (PP_FORM=gpu);
each program that they build is compiled for NVIDIA (clang and libclc to PTX, then ptxas), AMD
(clang and libclc, linked) and Intel (ocloc, the driver's own compiler). Fails on what does not
compile or link, on spilled registers, and on more local memory than all GPUs have.

If compilers are absent, Debian's packages of them are unpacked into build/gpu, not installed: that
needs no root, and Intel's driver would be one more OpenCL platform. NVIDIA's ptxas is not free, so
no package has it. Exit status: 1 for a failure, 2 if a compiler is missing.
"""

import argparse
import io
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple
from unittest.mock import patch

from pp_cl.cli import main as pp_cl
from pp_cl.drivers import open_device
from pp_cl.engine.device.device import STANDARD, Device, Program, kernel_folder
from pp_cl.engine.device.quirks import INTEL_PLATFORM, vendor_options
from pp_cl.scene.demo import demo_views
from pp_cl.scene.readers.transforms import write_scene
from pp_cl.selftest.run import CASES, run_cases

POCL = "Portable Computing Language"  # Intel's CPU runtime miscompiles the GPU form

TARGETS = ("sm_90", "gfx1100", "dg2")  # Hopper, RDNA 3, Arc
MOST_LOCAL = 32768  # bytes: Adreno, Mali, Apple's and older Intel GPUs have no more
FOLDER = Path(__file__).parents[1] / "build" / "gpu"
CLANG, LINKER, PTXAS, OCLOC = "clang-19", "ld.lld-19", "ptxas", "ocloc"
LIBRARIES = {"sm_": "nvptx64--nvidiacl.bc", "gfx": "amdgcn--amdhsa.bc"}
# {program or file: Debian's package that has it}
PACKAGES = {CLANG: "clang-19", LINKER: "lld-19", OCLOC: "intel-opencl-icd"}
PACKAGES |= dict.fromkeys(LIBRARIES.values(), "libclc-19")
CUDA = Path("/usr/local/cuda/bin")
# as ptxas, clang for AMD and ocloc print it
SPILL = r"(\d+) bytes spill stores|ScratchSize.*: (\d+)|spilled around (\d+)"
# The precision of divisions and square roots that OpenCL asks for, as in NVIDIA's driver.
ULP = ("-mllvm", "-nvptx-prec-divf32=1", "-mllvm", "-nvptx-prec-sqrtf32=0")


class Build(NamedTuple):
    """A program: cl/<file>.cl, built with -D for each macro "NAME=value"."""

    file: str
    macros: tuple[str, ...]

    def __str__(self) -> str:
        return " ".join((self.file, *self.macros))


class BuildError(Exception):
    """A build failed; the message is what the compiler or linker printed."""


@contextmanager
def recorded() -> Iterator[dict[Build, set[str]]]:
    """Record {program that any device builds: the kernels launched from it} within the block."""
    builds, program, launch = {}, Device.program, Program.launch

    def build(device, name, **defines):
        built = program(device, name, **defines)
        built.build = Build(name, tuple(f"{k}={v}" for k, v in sorted(defines.items())))
        builds.setdefault(built.build, set())
        return built

    def noted(self, kernel_name, /, *args, **arguments):
        builds[self.build].add(kernel_name)
        launch(self, kernel_name, *args, **arguments)

    with patch.object(Device, "program", build), patch.object(Program, "launch", noted):
        yield builds


def record() -> dict[Build, set[str]]:
    """Record what the selftest and two trainings (both blends, the paper's network) build and
    launch in the form for GPUs, on PoCL. Raises RuntimeError if one of them fails, UserError
    without PoCL.
    """
    with (
        patch.dict(os.environ, {"PP_FORM": "gpu", "PP_DEVICE": POCL}),
        TemporaryDirectory() as folder,
        recorded() as builds,
    ):
        dev = open_device()
        failed = [row.case for row in run_cases(dev, CASES) if not row.passed]
        write_scene({"train": demo_views(dev, "train", 4, 16)}, f"{folder}/scene")
        for preset in ("tiny", "paper"):
            words = ["--points", "500", "--iterations", "2", "--preset", preset]
            with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
                status = pp_cl(["train", f"{folder}/scene", "--out", f"{folder}/{preset}", *words])
            if status:
                failed.append(f"train --preset {preset}")
    if failed:
        raise RuntimeError(f"failed on the device at hand: {', '.join(failed)}")
    return builds


# --------------------------------------------------------------------------------------------------


def environment() -> dict[str, str]:
    """The environment in which unpacked programs find their libraries and each other."""
    libraries = [str(path) for path in sorted((FOLDER / "usr" / "lib").glob("*-linux-gnu"))]
    inherited = [os.environ[name] for name in ("LD_LIBRARY_PATH",) if os.environ.get(name)]
    programs = [os.environ["PATH"], str(FOLDER / "usr" / "bin")]
    paths = {"PATH": programs, "LD_LIBRARY_PATH": inherited + libraries}
    return {**os.environ, **{name: os.pathsep.join(folders) for name, folders in paths.items()}}


def find(name: str) -> str | None:
    """The path of a program, or of a file of libclc; None if it is not found."""
    places, mode = [environment()["PATH"]], os.X_OK
    if name == PTXAS:
        packages = Path(sysconfig.get_path("purelib"), "nvidia").glob(f"*/bin/{PTXAS}")
        places += [str(CUDA), *(str(path.parent) for path in packages)]
    elif name.endswith(".bc"):
        # not /usr/lib/clc, which may hold the files of another version of LLVM
        places, mode = [str(FOLDER / "usr" / "lib" / "clc")], os.R_OK
    return shutil.which(name, mode, os.pathsep.join(places))


def unpack_missing() -> str:
    """Unpack Debian's packages of absent programs. Returns what went wrong, or ""."""
    wanted = dict.fromkeys(package for name, package in PACKAGES.items() if not find(name))
    if not wanted:
        return ""
    if not shutil.which("apt-get") or not shutil.which("dpkg"):
        return "no apt-get here, which would fetch the compilers"
    debs = FOLDER / "packages"
    shutil.rmtree(debs, ignore_errors=True)
    debs.mkdir(parents=True)
    try:
        plan = _run(["apt-get", "install", "--simulate", "--no-install-recommends", *wanted])
        needed = dict.fromkeys([*wanted, *re.findall(r"(?m)^Inst (\S+)", plan)])
        _run(["apt-get", "download", *needed], debs)
        for deb in sorted(debs.glob("*.deb")):
            _run(["dpkg", "-x", str(deb), str(FOLDER)])
    except BuildError as error:
        reason = (str(error).splitlines() or ["no reason given"])[-1]
        return f"apt-get or dpkg failed ({reason}); apt-get update may help"
    shutil.rmtree(debs)
    return ""


def missing(target: str, problem: str) -> list[str]:
    """A line for each missing compiler of a target. problem: why it was not fetched."""
    kind = target[:3]
    names = {"sm_": (CLANG, PTXAS), "gfx": (CLANG, LINKER)}.get(kind, (OCLOC,))
    lines = []
    for name in (*names, *([LIBRARIES[kind]] if kind in LIBRARIES else [])):
        if not find(name):
            mend = "install CUDA's compiler, or nvidia-cuda-nvcc into .venv by pip"
            mend = mend if name == PTXAS else f"it is in Debian's package {PACKAGES[name]}"
            why = f" ({problem})" if problem else ""
            lines.append(f"{target} is not checked: {name} is missing: {mend}{why}")
    return lines


def _run(command, folder=None):
    """Run a command; returns what it prints. Raises BuildError if it fails."""
    path = shutil.which(command[0], path=environment()["PATH"])
    ran = subprocess.run(
        [path or command[0], *command[1:]],
        cwd=folder, env=environment(), capture_output=True, text=True, errors="replace",
    )  # fmt: skip
    output = ran.stdout + ran.stderr
    if ran.returncode or "Build failed" in output:
        raise BuildError(output.strip())
    return output


# --------------------------------------------------------------------------------------------------


def compile_build(target: str, build: Build, sources: Path, folder: Path) -> str:
    """Compile a build for a target; returns what the compilers print. folder: for the output.
    Raises BuildError.
    """
    kind, file = target[:3], str(sources / f"{build.file}.cl")
    platform = target if kind in LIBRARIES else INTEL_PLATFORM
    options = [*STANDARD, *vendor_options({"type": "GPU", "platform": platform}, build.file)]
    options += [f"-D{macro}" for macro in build.macros] + ["-I", str(sources)]
    if kind not in LIBRARIES:
        command = [find(OCLOC), "compile", "-file", file, "-device", target]
        return _run([*command, "-options", " ".join(options), "-out_dir", str(folder)])
    clang = [find(CLANG), "-x", "cl", "-O3", "-w", "-Wno-linker-warnings", *options, file]
    clang += ["-Xclang", "-mlink-builtin-bitcode", "-Xclang", find(LIBRARIES[kind])]
    if kind == "gfx":  # linked, as only the linker fails on undefined functions
        remarks = ["-nogpulib", "-Rpass-analysis=kernel-resource-usage"]
        link = [f"-fuse-ld={find(LINKER)}", "-o", str(folder / "x.co")]
        return _run([*clang, "--target=amdgcn-amd-amdhsa", f"-mcpu={target}", *remarks, *link])
    ptx = str(folder / "x.ptx")
    clang += ["--target=nvptx64-nvidia-nvcl", "-Xclang", "-target-cpu", "-Xclang", target, *ULP]
    _run([*clang, "-S", "-o", ptx])
    return _run([find(PTXAS), "-v", f"-arch={target}", ptx, "-o", str(folder / "x.cubin")])


def complaints(said: str) -> list[str]:
    """A line for each kernel that spills or takes too much local memory, from what ptxas, clang
    for AMD or ocloc printed. AMD's scratch memory also holds arrays whose index is not constant;
    scalar registers spill into vector registers.
    """
    problems, kernel = [], ""
    for line in said.splitlines():
        named = re.search(r"entry function '(\w+)'|Function Name: (\w+)|kernel (\w+)\s", line)
        kernel = next(filter(None, named.groups())) if named else kernel
        spill = re.search(SPILL, line)
        local = re.search(r"(\d+) bytes smem|LDS Size \[bytes/block\]: (\d+)", line)
        if spill and int(next(filter(None, spill.groups()))):
            problems.append(f"{kernel}: spills {spill[0]}")
        if local and int(local[1] or local[2]) > MOST_LOCAL:
            problems.append(f"{kernel}: {local[0]} of local memory; {MOST_LOCAL} are the most")
    return problems


def check(target: str, build: Build, kernels: set[str]) -> list[str]:
    """A line for each problem of a build for a target. kernels: those launched; complaints
    about the file's other kernels are dropped.
    """
    with TemporaryDirectory() as folder:
        try:
            output = compile_build(target, build, kernel_folder(), Path(folder))
            wrong = [line for line in complaints(output) if line.partition(":")[0] in kernels]
        except BuildError as error:
            wrong = [f"does not build or link: {error}"]
    return [f"{target} {build}: {line}" for line in wrong]


def main(arguments: list[str] | None = None) -> int:
    """Check all builds; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--targets", default=",".join(TARGETS), help="sm_*, gfx*, ocloc's names")
    targets = parser.parse_args(arguments).targets.split(",")
    problem = unpack_missing()
    absent = [line for target in targets for line in missing(target, problem)]
    there = [target for target in targets if not missing(target, problem)]
    builds = record()
    jobs = [(target, build, builds[build]) for target in there for build in sorted(builds)]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        wrong = [line for lines in pool.map(check, *zip(*jobs, strict=True)) for line in lines]
    print(*wrong, *absent, sep="\n", file=sys.stderr)
    print(f"{len(builds)} builds for {', '.join(there) or 'no target'}: {len(wrong)} complaints")
    return 1 if wrong else 2 if absent else 0


if __name__ == "__main__":
    sys.exit(main())
