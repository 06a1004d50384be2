"""The peak that benches compare with is that of a loop in C."""

import json
import os
import shutil
import statistics
import subprocess
import sys

import pytest

from pp_cl.device.discover import list_devices
from pp_cl.layers.choice import device_class

# multiply-adds in registers: CHAINS vectors of WIDTH floats, for SECONDS on each of THREADS
SOURCE = r"""
#include <pthread.h>
#include <stdio.h>
#include <time.h>
typedef float vector __attribute__((vector_size(4 * WIDTH)));
static double rate[THREADS];
static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + 1e-9 * t.tv_nsec;
}
static void *work(void *at) {
    vector x[CHAINS], sum = {0}, factor = sum + 0.5f, term = sum + 1.0f;
    for (int c = 0; c < CHAINS; c++) x[c] = sum + (float)c;
    const double start = now();
    long rounds = 0;
    while (now() - start < SECONDS) {
        for (int i = 0; i < 100000; i++)
#pragma GCC unroll 16
            for (int c = 0; c < CHAINS; c++) x[c] = x[c] * factor + term;
        rounds += 100000;
    }
    *(double *)at = 2.0 * WIDTH * CHAINS * rounds / (now() - start);
    for (int c = 0; c < CHAINS; c++) sum += x[c];
    return (void *)(long)(sum[0] > 1e9f);
}
int main(void) {
    pthread_t threads[THREADS];
    double all = 0;
    for (int i = 0; i < THREADS; i++) pthread_create(&threads[i], 0, work, &rate[i]);
    for (int i = 0; i < THREADS; i++) pthread_join(threads[i], 0), all += rate[i];
    printf("%f", all * 1e-9);
}
"""


# of a median, within which half of the rounds lie where nothing else runs; how often that is waited
# for
UNREST, ATTEMPTS = 0.05, 12

# what a process of its own prints: rates of our peak and of the loop, in turn
RATES = """
import json, subprocess, sys, time
from pp_cl.bench.timing import PeakFlops
from pp_cl.device.discover import open_device
peak, ours, loop = PeakFlops(open_device(sys.argv[1])), [], []
for _ in range(21):
    start = time.perf_counter()
    peak.run()
    ours.append(peak.flops / (time.perf_counter() - start) * 1e-9)
    loop.append(float(subprocess.check_output(sys.argv[2])))
print(json.dumps([ours, loop]))
"""


@pytest.mark.slow
@pytest.mark.parametrize("held", [False, True], ids=["as it is", "held to AVX2"])
def test_the_peak_is_that_of_a_loop_in_c(session_device, tmp_path, held):
    """Within 10 %, by medians of rounds in turn, also where a driver states another width than that
    of its code, as Intel's does when it is held to AVX2.
    """
    dev, compiler = session_device, shutil.which("gcc")
    width, platform = dev.device.native_vector_width_float, dev.device.platform.name
    if device_class(dev) != "CPU" or compiler is None or width not in (8, 16):
        pytest.skip("needs gcc, and a CPU with AVX2 or AVX-512")
    if held and (width == 8 or not platform.startswith("Intel")):
        pytest.skip("needs Intel's driver on a CPU with AVX-512")
    width = 8 if held else width
    (tmp_path / "loop.c").write_text(SOURCE)
    given = {"WIDTH": width, "CHAINS": 12 if width == 16 else 10, "SECONDS": 0.1}
    given["THREADS"] = dev.info["compute_units"]
    words = [f"-D{name}={value}" for name, value in given.items()]
    words += ["-O3", "-march=native", f"-mprefer-vector-width={32 * width}", "-pthread"]
    words += ["-mno-avx512f"] if width == 8 else []
    program = str(tmp_path / "loop")
    subprocess.run([compiler, *words, str(tmp_path / "loop.c"), "-o", program], check=True)
    env = os.environ | {"PYOPENCL_NO_CACHE": "1"}  # which does not tell the targets apart
    env |= {"CL_CONFIG_CPU_TARGET_ARCH": "core-avx2"} if held else {}
    index = next(i for i, found, _ in list_devices() if found == dev.device)
    for _ in range(ATTEMPTS):
        told = subprocess.check_output([sys.executable, "-c", RATES, index, program], env=env)
        quartiles = [statistics.quantiles(rates) for rates in json.loads(told)]
        if all(high - low < UNREST * middle for low, middle, high in quartiles):
            (_, ours, _), (_, loop, _) = quartiles
            assert ours / loop == pytest.approx(1, abs=0.1)
            return
    pytest.skip("other programs keep this machine busy")
