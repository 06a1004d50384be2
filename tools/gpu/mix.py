"""What the inner loops of the convolutions for GPUs consist of: instructions of sm_90 and gfx1100.

    python -m tools.gpu.mix                       # every kernel in LOOPS, with every set of options
    python -m tools.gpu.mix --targets sm_80       # other GPUs: sm_*, gfx*

The inner loop is the one with the most multiply-adds that holds no other. Arithmetic is what is
neither an access to memory nor control: moves, comparisons and addresses count. Exit status 2 where
a compiler is missing.
"""

import argparse
import re
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from pp_cl.device.device import kernel_folder
from tools.gpu.builds import Build, read_builds
from tools.gpu.compilers import assembly
from tools.gpu.packages import CompilerMissing

TARGETS = ("sm_90", "gfx1100")
# {kernel file: those of its kernels that multiply}
LOOPS = {
    "layers/conv_local": ("conv_local_backward_input", "conv_local_forward"),
    "layers/conv_local_backward_weights": ("conv_local_backward_weights",),
    "layers/winograd_gemm": ("winograd_gemm_multiply",),
}

# NVIDIA's, then AMD's: `/*0010*/ @P0 FFMA R1, R2, R3, R1 ;` and `v_fma_f32 v1, v2, v3, v1`
_SASS = re.compile(r"^\s*/\*[0-9a-f]{4,}\*/\s+(?:@!?U?P\w+\s+)?([A-Z][\w.]*)(.*?);")
_GCN = re.compile(r"^\s+([a-z]\w*)(.*)")
_LABEL = re.compile(r"^(\.L\w+):")
_TARGET = re.compile(r"\.L\w+")
_KERNEL = re.compile(r"^([a-z]\w*):")
_MULTIPLY_ADD = re.compile(r"FFMA|v_(dual_|pk_)?(fma|fmac|fmaak|fmamk)_f32")
_MEMORY = re.compile(r"(LD|ST)[GSLC]?(\.|$)|(ds|global|flat|scratch|buffer)_|s_(buffer_)?load")
_CONTROL = re.compile(
    r"BRA|BAR|NOP|EXIT|BSSY|BSYNC|WARPSYNC|s_(c?branch|waitcnt|barrier|nop|delay|clause|endpgm)"
)


@dataclass(frozen=True)
class Mix:
    """Instructions of a loop."""

    multiply_adds: int
    other_arithmetic: int
    memory: int
    control: int

    @property
    def share(self) -> float:
        """Of multiply-adds among the arithmetic ones."""
        return self.multiply_adds / max(1, self.multiply_adds + self.other_arithmetic)


def inner_loops(text: str) -> dict[str, Mix]:
    """{kernel: the mix of its inner loop} of an assembly listing."""
    found = {}
    for kernel, operations in _kernels(text).items():
        mixes = [_mix(operations[first : last + 1]) for first, last in _innermost(operations)]
        if mixes:
            found[kernel] = max(mixes, key=lambda mix: mix.multiply_adds)
    return found


def _kernels(text):
    """{kernel: [label, or operation and operands]}."""
    found, lines = {}, []
    for line in text.splitlines():
        if kernel := _KERNEL.match(line):
            lines = found[kernel[1]] = []
        elif label := _LABEL.match(line):
            lines.append((label[1], None))
        elif operation := _SASS.match(line) or (None if "/*" in line else _GCN.match(line)):
            # two at once in AMD's: v_dual_fmac_f32 v0, v1, v2 :: v_dual_mov_b32 v3, v4
            first, *more = f"{operation[1]}{operation[2]}".split("::")
            lines += [tuple(f"{part.strip()} ".split(" ", 1)) for part in (first, *more)]
    return found


def _innermost(operations):
    """(first, last) of every loop that holds no other: from a label to a branch back to it."""
    labels = {name: i for i, (name, operands) in enumerate(operations) if operands is None}
    loops = []
    for i, (name, operands) in enumerate(operations):
        if operands is not None and ("BRA" in name or "branch" in name):
            to = labels.get((_TARGET.search(operands) or [None])[0], i + 1)
            loops += [(to, i)] if to <= i else []
    return [
        (a, b)
        for a, b in loops
        if not any((a, b) != (c, d) and a <= c and d <= b for c, d in loops)
    ]


def _mix(operations):
    counts = Counter()
    for name, operands in operations:
        if operands is None:
            continue
        kinds = (_MULTIPLY_ADD, _MEMORY, _CONTROL)
        kind = next((k for k in kinds if k.match(name)), None)
        counts[kind] += 2 if name.startswith("v_pk_") else 1
    return Mix(counts[_MULTIPLY_ADD], counts[None], counts[_MEMORY], counts[_CONTROL])


def mixes(target: str, build: Build) -> dict[str, Mix]:
    """{kernel in LOOPS: the mix of its inner loop} of a build. Raises BuildError,
    CompilerMissing.
    """
    with TemporaryDirectory() as folder:
        found = inner_loops(assembly(target, build, kernel_folder(), Path(folder)))
    return {kernel: found[kernel] for kernel in LOOPS[build.file]}


def main(arguments: list[str] | None = None) -> int:
    """Returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--targets", default=",".join(TARGETS), help="sm_*, gfx*")
    targets = parser.parse_args(arguments).targets.split(",")
    for build in sorted(build for build in read_builds() if build.file in LOOPS):
        for target in targets:
            try:
                found = mixes(target, build)
            except CompilerMissing as error:
                print(f"{target} is not looked at: {error}", file=sys.stderr)
                return 2
            for kernel, mix in found.items():
                print(
                    f"{target} {' '.join(build.macros)}: {kernel}: {mix.multiply_adds}"
                    f" multiply-adds, {mix.other_arithmetic} other arithmetic ({mix.share:.1%}),"
                    f" {mix.memory} accesses, {mix.control} control"
                )
    return 0


if __name__ == "__main__":
    sys.exit(main())
