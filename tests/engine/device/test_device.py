import atexit
import gc
import re
import signal
import weakref
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest
from support.guarded import GuardedDevice

from pp_cl.drivers import open_device
from pp_cl.engine.device import device as device_module
from pp_cl.engine.device import quirks
from pp_cl.engine.device.device import Device, kernel_folder
from pp_cl.engine.device.quirks import acts_as_cpu
from pp_cl.errors import BuildError, UserError

TINY = """
// One work-item per element: overwrites y with 0 / x.
kernel void divide(
    const uint n,              // elements
    global const float *x,     // (N)
    global float *y)           // (N)
{
    const uint i = get_global_id(0);
    if (i >= n) return;
    y[i] = 0.0f / x[i];
}
"""


@pytest.fixture
def tiny(tmp_path, monkeypatch):
    (tmp_path / "tiny.cl").write_text(TINY)
    monkeypatch.setattr(device_module, "kernel_folder", lambda: tmp_path)
    return tmp_path


def test_a_device_that_nobody_has_is_gone_with_its_memory(session_device):
    device = Device(session_device.device)
    device.scratch("mine", 100)
    device.program("training/adam")
    gone = weakref.ref(device)
    del device
    gc.collect()
    assert gone() is None


def test_upload_fill_zeros_copy(dev, rng):
    values = rng.random((16, 31)).T  # float64, not contiguous
    a, b = dev.upload(values, np.float32), dev.zeros((31, 16))
    assert np.array_equal(b.get(), np.zeros((31, 16)))
    dev.copy(b, a)
    assert np.array_equal(b.get(), values.astype(np.float32))
    for dtype in (np.uint8, np.int32, np.uint64):
        c = dev.empty((257,), dtype)
        dev.fill(c, 7)
        assert np.array_equal(c.get(), np.full(257, 7, dtype))
    dev.fill(a, 2.5)
    assert np.array_equal(a.get(), np.full((31, 16), 2.5))
    assert np.array_equal(b.get(), values.astype(np.float32))
    for other in (dev.zeros((32, 16)), dev.zeros((31, 15)), dev.zeros((31, 16), np.uint32)):
        with pytest.raises(ValueError, match="copy"):
            dev.copy(b, other)


@pytest.mark.parametrize("values", [np.zeros(8, np.float32), np.zeros(9, np.float64)])
def test_writing_what_does_not_fit(dev, values):
    for write in (dev.write, dev.send):
        with pytest.raises(ValueError, match="write"):
            write(dev.zeros((9,)), values)


def test_scratch_is_shared_by_name_and_grows(plain):
    first = plain.scratch("a", 100, zeros=16)
    assert not first[:16].get().any()
    plain.fill(first, 1)
    assert plain.scratch("a", 50, zeros=16) is first and first.get().all()
    assert plain.scratch("b", 50) is not first
    del first
    assert plain.scratch("a", 101, np.uint32).dtype == np.uint32
    assert plain.bytes == 4 * (101 + 50) and plain.peak_bytes == plain.bytes


def test_memory_is_counted_and_given_back(plain):
    a = plain.zeros((1000,))
    b = plain.empty((500, 2), np.uint64)
    assert plain.bytes == plain.peak_bytes == 4000 + 8000
    del b
    assert (plain.bytes, plain.peak_bytes) == (4000, 12000)
    part = a[:10].reshape(5, 2).view(np.uint32)  # a view holds all of the memory
    del a
    assert plain.bytes == 4000
    del part
    assert (plain.bytes, plain.peak_bytes) == (0, 12000)


def test_buffers_are_held_to_the_largest_allocation_and_to_the_memory(plain):
    plain.info["max_allocation_bytes"], plain.info["memory_bytes"] = 1000, 2200
    held = plain.empty((250,))
    with pytest.raises(UserError, match=r"a buffer of shape \(251,\) needs .*lower --points"):
        plain.empty((251,))
    more = plain.empty((250,))
    with pytest.raises(UserError, match="in use"):
        plain.upload(np.zeros(51, np.float32))
    assert plain.bytes == held.nbytes + more.nbytes
    plain.empty((50,))


@pytest.mark.parametrize(
    "variable, text",
    [
        ("PP_MAX_ALLOCATION", "0"),
        ("PP_MAX_ALLOCATION", "nan"),
        ("PP_DEBUG", "4"),
        ("PP_FORM", "tpu"),
    ],
)
def test_a_bad_variable_is_one_line(monkeypatch, variable, text):
    monkeypatch.setenv(variable, text)
    with pytest.raises(UserError, match=f"^{variable}={text}: "):
        open_device()


def test_a_cpu_works_as_one_unless_told_otherwise(dev, monkeypatch):
    of_device = bool(dev.device.type & cl.device_type.CPU)
    monkeypatch.delenv("PP_FORM", raising=False)
    assert acts_as_cpu(dev.device) == of_device
    monkeypatch.setenv("PP_FORM", "")
    assert acts_as_cpu(dev.device) == of_device
    monkeypatch.setenv("PP_FORM", "gpu")
    assert not acts_as_cpu(dev.device) and not open_device().is_cpu


@pytest.mark.parametrize("error", [cl.MemoryError, cl.RuntimeError, cl.LogicError])
def test_a_driver_that_gives_up_is_a_user_error(plain, error):
    def refuse(*_):
        raise error("clEnqueueNDRangeKernel failed: OUT_OF_RESOURCES")

    with pytest.raises(error if error is cl.LogicError else UserError) as caught:
        plain.attempt("run x.cl:y", refuse, 1)
    if error is not cl.LogicError:
        text = r"\S.* cannot run x.cl:y for want of memory, or since the driver ended a kernel \(.*"
        assert re.match(
            text + "OUT_OF_RES.*lower --points.*the log of the system", str(caught.value)
        )


def test_fresh_guarded_buffers_are_nan(dev):
    assert np.isnan(dev.empty((33,)).get()).all()
    assert (dev.empty((33,), np.uint32).get() == 0xFFFFFFFF).all()


def test_a_build_error_names_file_options_and_cause(plain, tiny):
    (tiny / "broken.cl").write_text(
        "kernel void f(\n    global float *x)  // (N)\n{ x[0] = undeclared_thing; }\n"
    )
    with pytest.raises(
        BuildError, match=r"^cl/broken\.cl does not build on .* with .*-DDEGREE=2"
    ) as error:
        plain.program("broken", DEGREE=2)
    assert "undeclared_thing" in error.value.log


@pytest.mark.parametrize(
    ("platform", "kind", "large"),
    [
        ("Intel(R) OpenCL Graphics", "GPU", True),
        ("Apple", "GPU", False),  # drives Intel's GPUs too, and refuses unknown options
        ("NVIDIA CUDA", "GPU", False),
    ],
)
def test_intels_gpus_take_more_registers_for_files_that_spill(platform, kind, large):
    info = {"platform": platform, "type": kind}
    expected = ("-cl-intel-256-GRF-per-thread",) if large else ()
    assert quirks.vendor_options(info, "layers/conv_backward") == expected
    assert quirks.vendor_options(info, "raster/shade") == ()
    for driver, expected in (("Intel(R) OpenCL", ("-DREADS_AHEAD",)), ("rusticl", ())):
        info = {"platform": driver, "type": "CPU"}
        assert quirks.vendor_options(info, "layers/conv_backward") == expected
    files = quirks.SPILLING_ON_INTEL
    assert all((kernel_folder() / f"{name}.cl").is_file() for name in files)


@pytest.mark.parametrize("said, expected", [(1, True), (0, False), (None, True)])
def test_only_nvidias_driver_rules_out_a_watchdog(said, expected):
    class Driver:
        @property
        def kernel_exec_timeout_nv(self):
            if said is None:
                raise cl.LogicError("clGetDeviceInfo failed: INVALID_VALUE")
            return said

    assert quirks.has_watchdog(Driver()) is expected


def test_a_kernel_folder_with_a_space_is_refused(plain, tmp_path, monkeypatch):
    monkeypatch.setattr(device_module, "kernel_folder", lambda: tmp_path / "a b")
    with pytest.raises(UserError, match="a b: .*space"):
        plain.program("tiny")


@pytest.fixture
def debugged(session_device, tiny, monkeypatch):
    made = []

    def make(level, values, guarded=False):
        monkeypatch.setenv("PP_DEBUG", level)
        device = (GuardedDevice if guarded else Device)(session_device.device)
        made.append(device)
        x = device.upload(np.array(values, np.float32))
        device.program("tiny").launch("divide", x.size, n=x.size, x=x, y=device.empty(x.shape))
        device.finish()
        return device

    yield make
    for device in made:
        atexit.unregister(device.print_profile)


@pytest.mark.parametrize("level, labels", [("0", []), ("3", ["tiny.cl:divide"])])
def test_debug_0_measures_nothing_and_3_is_content_with_numbers(debugged, level, labels):
    assert list(debugged(level, [1, 2, 3])._seconds) == labels


@pytest.mark.parametrize("level, label", [("1", "tiny.cl "), ("2", "tiny.cl:divide ")])
def test_debug_1_times_files_and_2_times_kernels(debugged, monkeypatch, capsys, level, label):
    printed = []
    monkeypatch.setattr("atexit.register", printed.append)
    device = debugged(level, [1, 2, 0])
    seconds = device._seconds["tiny.cl:divide"]
    assert len(seconds) == 1
    assert 0 <= seconds[0] < 10
    (at_exit,) = printed
    at_exit()
    shown = capsys.readouterr()
    assert "tiny.cl" in shown.err and "built in" in shown.err
    assert shown.err.splitlines()[-1].startswith(label)
    assert shown.out == ""


@pytest.mark.parametrize("guarded", [False, True])
@pytest.mark.exact
def test_debug_3_finds_a_nan(debugged, guarded):
    with pytest.raises(FloatingPointError, match="tiny.cl:divide: y has 2 NaN or Inf, first at 1"):
        debugged("3", [1, 0, 2, 0], guarded)


@pytest.mark.exact
def test_debug_3_takes_infinity_where_the_kernel_says_so(debugged, tiny):
    may = TINY.replace("0.0f /", "1.0f /").replace(
        "y)           // (N)", "y)  // (N) infinite at 0"
    )
    (tiny / "tiny.cl").write_text(may)
    debugged("3", [1, 0])
    with pytest.raises(FloatingPointError, match="y has 1 NaN or Inf, first at 0"):
        debugged("3", [np.nan, 0])


@pytest.mark.skipif(not hasattr(signal, "SIGXFSZ"), reason="only Unix has the signal")
def test_a_file_that_grows_too_large_is_an_error_alone(dev):
    """Drivers catch the signal once loaded, unknown to Python; the device ignores it again."""
    own = Path("/proc/self/status")
    if not own.exists():
        pytest.skip("no /proc")
    ignored = next(line for line in own.read_text().splitlines() if line.startswith("SigIgn"))
    assert int(ignored.split()[1], 16) >> (signal.SIGXFSZ - 1) & 1
