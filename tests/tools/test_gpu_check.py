import pytest

from pp_cl.drivers import open_device
from pp_cl.engine.device.buffers import gather_rows
from pp_cl.engine.device.device import Device, kernel_folder
from pp_cl.engine.device.signature import parse_signatures
from tools import gpu_check
from tools.gpu_check import complaints

CPU_FILES = {"layers/winograd", "layers/winograd_backward"}
PTXAS = """ptxas info    : Compiling entry function 'one' for 'sm_90'
    112 bytes stack frame, {} bytes spill stores, 8 bytes spill loads
ptxas info    : Used 255 registers, used 1 barriers, {} bytes smem, 400 bytes cmem[0]
"""
REMARKS = """x.cl:98:1: remark: Function Name: one [-Rpass-analysis=kernel-resource-usage]
x.cl:98:1: remark:     ScratchSize [bytes/lane]: {} [-Rpass-analysis=kernel-resource-usage]
x.cl:98:1: remark:     LDS Size [bytes/block]: {} [-Rpass-analysis=kernel-resource-usage]
"""
OCLOC = "warning: kernel one  compiled SIMD8 allocated 128 regs and spilled around 157\n"


@pytest.mark.parametrize("text", [PTXAS, REMARKS])
def test_what_is_too_much_is_read(text):
    assert complaints(text.format(0, 32768)) == []
    assert [line[:5] for line in complaints(text.format(24, 32772))] == ["one: "] * 2
    assert complaints(OCLOC) == ["one: spills spilled around 157"]


def test_what_is_built_and_launched_is_recorded():
    with gpu_check.recorded() as builds:
        dev = open_device()
        gather_rows(dev, dev.zeros((3, 4)), dev.upload([2, 0], "uint32"))
    assert [(build.file, kernels) for build, kernels in builds.items()] == [
        ("device/rows", {"gather_rows"})
    ]
    assert Device.program.__name__ == "program"


@pytest.mark.slow
def test_every_kernel_that_gpus_have_is_launched():
    launched = {(build.file, k) for build, kernels in gpu_check.record().items() for k in kernels}
    missing = set()
    for path in kernel_folder().rglob("*.cl"):
        file = path.relative_to(kernel_folder()).with_suffix("").as_posix()
        missing |= {(file, k) for k in parse_signatures(path.read_text("utf-8"), file)} - launched
    assert {kernel for kernel in missing if kernel[0] not in CPU_FILES} == {
        ("raster/pairs", "pairs_sort")  # of CPUs alone
    }
