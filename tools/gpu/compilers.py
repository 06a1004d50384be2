"""What a GPU's compiler says of the kernels of a build: their registers, spills and memory.

NVIDIA: clang and libclc to PTX, then ptxas. AMD: clang and libclc, linked. Intel: ocloc, the
driver's own compiler without a device. The drivers of NVIDIA and AMD hold other versions of the
same compilers.
"""

import hashlib
import json
import re
import struct
import subprocess
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from pp_cl.device.device import INTEL_PLATFORM, STANDARD, vendor_options
from pp_cl.files.atomic import write_json
from tools.gpu.builds import Build
from tools.gpu.packages import (
    AMD_LIBRARY,
    CLANG,
    FOLDER,
    LINKER,
    NVDISASM,
    NVIDIA_LIBRARY,
    OCLOC,
    PTXAS,
    environment,
    find,
)

# What OpenCL asks of a division and of a square root, as NVIDIA's driver takes it.
ULP = ("-mllvm", "-nvptx-prec-divf32=1", "-mllvm", "-nvptx-prec-sqrtf32=0")


CACHE = FOLDER / "cache"


class BuildError(Exception):
    """What a compiler or linker said of a build that failed."""


@dataclass(frozen=True)
class Usage:
    """What a kernel takes.

    registers: of a work-item, of Intel of a thread. spill: NVIDIA: bytes stored and loaded; else
    registers. private: bytes of arrays and spills in memory, of a work-item. local: bytes of a
    work-group. simd: work-items of a thread on Intel, else None.
    """

    registers: int
    spill: int
    private: int
    local: int
    simd: int | None = None


def cached_build(target: str, build: Build, sources: Path, compilers: str) -> dict[str, Usage]:
    """As compile_build(); from a file where it was compiled before. compilers: version(target)."""
    texts = [sources / f"{build.file}.cl", *sorted(sources.rglob("*.h")), Path(__file__)]
    contents = [path.read_text("utf-8") for path in texts]
    about = repr((_options(target, build), target, build, compilers, contents))
    cache = CACHE / f"{hashlib.sha256(about.encode()).hexdigest()}.json"
    if cache.is_file():
        rows = json.loads(cache.read_text("utf-8"))
        return {kernel: Usage(**row) for kernel, row in rows.items()}
    with TemporaryDirectory() as folder:
        found = compile_build(target, build, sources, Path(folder))
    cache.parent.mkdir(parents=True, exist_ok=True)
    write_json(cache, {kernel: asdict(usage) for kernel, usage in found.items()})
    return found


def compile_build(target: str, build: Build, sources: Path, folder: Path) -> dict[str, Usage]:
    """{kernel: Usage} of a build. target: sm_90, gfx1100, or one of ocloc's devices. folder: for
    what is compiled. Raises BuildError, CompilerMissing.
    """
    options = [*_options(target, build), "-I", str(sources)]
    return _backend(target)(target, options, sources / f"{build.file}.cl", folder)


def assembly(target: str, build: Build, sources: Path, folder: Path) -> str:
    """The instructions of a build for sm_* (SASS) or gfx*, as text. As compile_build(); raises
    ValueError for other targets.
    """
    options, file = [*_options(target, build), "-I", str(sources)], sources / f"{build.file}.cl"
    if _backend(target) is _nvidia:
        nvdisasm = find(NVDISASM)
        _nvidia(target, options, file, folder)
        return _run([nvdisasm, "-c", str(folder / "x.cubin")])
    if _backend(target) is _amd:
        clang = _clang("--target=amdgcn-amd-amdhsa", AMD_LIBRARY, options, str(file))
        _run([*clang, f"-mcpu={target}", "-nogpulib", "-S", "-o", str(folder / "x.s")])
        return (folder / "x.s").read_text("utf-8")
    raise ValueError(f"{target}: no assembly of it")


def _options(target, build):
    """Those that the drivers pass, but for the folder of the headers."""
    platform = INTEL_PLATFORM if _backend(target) is _intel else target
    vendors = vendor_options({"type": "GPU", "platform": platform}, build.file)
    return [*STANDARD, *vendors, *(f"-D{macro}" for macro in build.macros)]


def _backend(target: str) -> Callable[..., dict[str, Usage]]:
    return {"sm_": _nvidia, "gfx": _amd}.get(target[:3], _intel)


def version(target: str) -> str:
    """The names and versions of a target's compilers. Raises CompilerMissing."""
    backend = _backend(target)
    if backend is _intel:
        with TemporaryDirectory() as folder:
            _run([find(OCLOC), "query", "OCL_DRIVER_VERSION"], folder)
            said = Path(folder, "OCL_DRIVER_VERSION").read_text()
            return f"ocloc {said.strip().strip(chr(0))}"
    clang = f"clang {_version_said(CLANG)}"
    find(NVIDIA_LIBRARY if backend is _nvidia else AMD_LIBRARY)
    return f"{clang}, ptxas {_version_said(PTXAS)}" if backend is _nvidia else clang


def _version_said(program):
    """The version number that a program prints."""
    found = re.search(r"\d+\.\d+\.\d+", _run([find(program), "--version"]))
    return found[0] if found else "of unknown version"


def _run(command, folder=None):
    """What a compiler prints. Raises BuildError."""
    ran = subprocess.run(
        command, cwd=folder, env=environment(), capture_output=True, text=True, errors="replace"
    )
    said = ran.stdout + ran.stderr
    if ran.returncode or "Build failed" in said:
        raise BuildError(said.strip())
    return said


def _clang(target, bitcode, options, source):
    """clang's command as far as NVIDIA's and AMD's agree."""
    linked = ("-Xclang", "-mlink-builtin-bitcode", "-Xclang", find(bitcode))
    quiet = ("-w", "-Wno-linker-warnings")
    return [find(CLANG), "-x", "cl", "-O3", target, *linked, *quiet, *options, source]


def _nvidia(arch, options, source, folder):
    ptx, cubin = str(folder / "x.ptx"), str(folder / "x.cubin")
    clang = _clang("--target=nvptx64-nvidia-nvcl", NVIDIA_LIBRARY, options, str(source))
    _run([*clang, "-Xclang", "-target-cpu", "-Xclang", arch, *ULP, "-S", "-o", ptx])
    return parse_ptxas(_run([find(PTXAS), "-v", f"-arch={arch}", ptx, "-o", cubin]))


def _amd(arch, options, source, folder):
    # linked: only then undefined functions fail
    clang = _clang("--target=amdgcn-amd-amdhsa", AMD_LIBRARY, options, str(source))
    remarks = ("-nogpulib", "-Rpass-analysis=kernel-resource-usage")
    linker = f"-fuse-ld={find(LINKER)}"
    return parse_remarks(
        _run([*clang, f"-mcpu={arch}", *remarks, linker, "-o", str(folder / "x.co")])
    )


def _intel(device, options, source, folder):
    command = [find(OCLOC), "compile", "-file", str(source), "-device", device]
    command += ["-internal_options", "-cl-intel-allow-zebin", "-options", " ".join(options)]
    said = _run([*command, "-out_dir", str(folder), "-output", "x", "-output_no_suffix"])
    info = elf_section((folder / "x").read_bytes(), ".ze_info").decode(errors="replace")
    return parse_ze_info(info, said)


def parse_ptxas(said: str) -> dict[str, Usage]:
    """Usage by kernel from ptxas -v."""
    blocks = re.findall(
        r"Compiling entry function '(\w+)'.*?(\d+) bytes stack frame, (\d+) bytes spill stores,"
        r" (\d+) bytes spill loads.*?Used (\d+) registers([^\n]*)",
        said,
        re.DOTALL,
    )
    found = {}
    for kernel, stack, stores, loads, registers, rest in blocks:
        shared = re.search(r"(\d+) bytes smem", rest)
        found[kernel] = Usage(
            int(registers),
            int(stores) + int(loads),
            int(stack),
            int(shared[1]) if shared else 0,
        )
    return found


def parse_remarks(said: str) -> dict[str, Usage]:
    """Usage by kernel from clang's remarks for AMD."""
    kernels, numbers = {}, {}
    for key, value in re.findall(r"remark:\s+([^:\n]+): (\S+) \[-Rpass-analysis", said):
        if key == "Function Name":
            numbers = kernels[value] = {}
        elif value.isdigit():
            numbers[key] = int(value)
    return {
        kernel: Usage(
            n["VGPRs"],
            n["VGPRs Spill"] + n["SGPRs Spill"],
            n["ScratchSize [bytes/lane]"],
            n["LDS Size [bytes/block]"],
        )
        for kernel, n in kernels.items()
    }


def parse_ze_info(info: str, said: str) -> dict[str, Usage]:
    """Usage by kernel from the section .ze_info of Intel's binary and from what ocloc printed."""
    spills = dict(re.findall(r"kernel (\w+)\s+compiled SIMD.* spilled around (\d+)", said))
    found = {}
    for part in info.partition("kernels_misc_info")[0].split("\n  - name:")[1:]:
        kernel = part.split()[0].strip("'\"")
        buffers = re.findall(r"-\s+type:\s+\w+\s+usage:\s+(\w+)\s+size:\s+(\d+)", part)
        found[kernel] = Usage(
            _number(part, "grf_count"),
            int(spills.get(kernel, 0)),
            sum(int(size) for usage, size in buffers if usage != "spill_fill_space"),
            _number(part, "slm_size"),
            _number(part, "simd_size"),
        )
    return found


def _number(text, key):
    """Of `key: number` in YAML, 0 where there is none."""
    found = re.search(rf"\b{key}:\s+(\d+)", text)
    return int(found[1]) if found else 0


def elf_section(data: bytes, wanted: str) -> bytes:
    """A section of a 64-bit ELF file. Raises BuildError where there is none. objcopy refuses
    Intel's files.
    """
    if data[:4] == b"\x7fELF":
        (table,) = struct.unpack_from("<Q", data, 0x28)
        size, count, names = struct.unpack_from("<HHH", data, 0x3A)
        heads = [struct.unpack_from("<IIQQQQ", data, table + i * size) for i in range(count)]
        for name, _, _, _, start, length in heads:
            first = heads[names][4] + name
            if data[first : data.index(b"\0", first)].decode() == wanted:
                return data[start : start + length]
    raise BuildError(f"the compiler's output has no section {wanted}")
