import os
import subprocess
import sys
from types import SimpleNamespace

import pytest
from support.devices import fake
from support.refused import refusing

from pp_cl import drivers, speeds
from pp_cl.drivers import (
    find_problem,
    list_devices,
    mend,
    open_device,
    separate_devices,
)


@pytest.fixture
def listed(monkeypatch):
    """A function that sets what list_devices() returns; open_device() then returns the cl.Device
    instead of a Device. No speed is kept.
    """
    monkeypatch.setattr(drivers, "Device", lambda d: d)
    monkeypatch.setattr(speeds, "kept_speeds", lambda _: {})
    monkeypatch.delenv("PP_DEVICE", raising=False)
    return lambda *listed_devices: monkeypatch.setattr(
        drivers, "list_devices", lambda **_: list(listed_devices)
    )


def test_listed_devices_are_probed(session_device):
    devices = list_devices()
    (index,) = (i for i, d, p in devices if d == session_device.device and p is None)
    assert len({i for i, _, _ in devices}) == len(devices)
    assert open_device(index).device == session_device.device


def test_without_speeds_a_gpu_that_works_comes_first(listed):
    cpu, gpu = fake("PoCL", "cpu"), fake("NVIDIA CUDA", "H200", gpu=True, index="1:0")
    listed(cpu, gpu)
    assert open_device() is gpu[1]
    listed(fake("rusticl", "llvmpipe", gpu=True, problem="does not run: x", index="1:0"), cpu)
    assert open_device() is cpu[1]


CHOICES = {"0:0": 0, "1:0": 1, "1:1": 2, "intel": 1, "Portable": 0, "h200": 2, "cuda": 2}
# A PoCL device is named after the processor: a match of the whole name wins over a part of a name.
CHOICES |= {"Intel(R) Xeon(R)": 1, "xeon": 1}  # "xeon" fits several: the default one of them


@pytest.mark.parametrize("choice", CHOICES)
@pytest.mark.parametrize("variable", [False, True])
def test_choice_by_index_and_name(listed, monkeypatch, choice, variable):
    listed_devices = [
        fake("Portable Computing Language", "cpu-haswell-Intel(R) Xeon(R)"),
        fake("Intel(R) OpenCL", "Intel(R) Xeon(R)", index="1:0"),
        fake("NVIDIA CUDA", "NVIDIA H200", gpu=True, index="1:1"),
    ]
    listed(*listed_devices)
    monkeypatch.setenv("PP_DEVICE", choice if variable else "0:0")  # an argument takes precedence
    assert open_device(None if variable else choice) is listed_devices[CHOICES[choice]][1]


def test_what_cannot_be_opened_is_told_and_not_replaced(listed):
    works = "found 0:0 good (A) works"
    broken = fake("B", "bad", problem="does not run: no target", index="1:0")
    listed(fake("A", "good"))
    with refusing(f"device 'radeon': no such OpenCL device; {works}"):
        open_device("radeon")
    listed(fake("A", "good"), broken)
    wanted = f"({works}; 1:0 bad (B) does not run: no target)"
    with refusing(f"device 'bad': no working OpenCL device {wanted}: install"):
        open_device("bad")
    listed()
    with refusing("no working OpenCL device (found none): install"):
        open_device()


def test_devices_that_can_work_side_by_side(listed, monkeypatch):
    h200 = [fake("NVIDIA CUDA", "H200", gpu=True, index=f"0:{i}") for i in range(2)]
    again = [fake("PoCL", "H200 ", gpu=True, index=f"1:{i}") for i in range(2)]
    broken = fake("C", "other", gpu=True, problem="does not run: x", index="2:0")
    arc = fake("Intel", "Arc", gpu=True, index="3:0")
    cpus = [fake("PoCL", "cpu", index="4:0"), fake("Intel", "Xeon", index="5:0")]
    listed(*cpus, *h200, *again, broken, arc)
    assert separate_devices() == ["0:0", "0:1", "3:0"]
    listed(broken, *cpus)
    assert separate_devices() == ["4:0"]
    listed(broken)
    with refusing("no working OpenCL device"):
        separate_devices()
    monkeypatch.setenv("PP_DEVICE", "xeon")
    assert separate_devices() == ["xeon"]


@pytest.mark.parametrize(
    "system, machine, tool, word",
    [
        ("linux", "x86_64", "apt-get", "pip install intel-opencl-rt"),
        ("win32", "AMD64", "", "pip install intel-opencl-rt"),
        ("linux", "aarch64", "apt-get", "apt install pocl-opencl-icd"),
        ("darwin", "arm64", "", "conda install"),
    ],
)
def test_one_command_for_each_system(monkeypatch, system, machine, tool, word):
    monkeypatch.setattr("sys.platform", system)
    monkeypatch.setattr("platform.machine", lambda: machine)
    monkeypatch.setattr("shutil.which", lambda name: name == tool)
    monkeypatch.setattr(drivers, "in_conda", lambda: False)
    monkeypatch.setattr(drivers, "runtime_library", lambda: None)
    assert f"`{word}" in mend() or f"`sudo {word}" in mend()
    assert mend().count("`") == 2


def test_a_cache_folder_that_cannot_be_written_is_replaced(session_device, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    index = next(i for i, d, _ in list_devices() if d == session_device.device)
    script = (
        "import os; from pp_cl.drivers import open_device; "
        f"open_device({index!r}).program('training/adam'); print(os.environ['XDG_CACHE_HOME'])"
    )
    ran = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        env={**os.environ, "XDG_CACHE_HOME": str(blocked / "cache")},
    )
    assert ran.returncode == 0, ran.stderr
    assert "set XDG_CACHE_HOME to keep them" in ran.stderr
    assert not os.path.exists(ran.stdout.strip())  # the folder is removed with the process


@pytest.mark.unix
def test_a_cache_folder_in_which_nothing_runs_is_replaced(tmp_path, monkeypatch):
    """PoCL ends the process if its cache is on a file system mounted noexec."""
    caches = {"XDG_CACHE_HOME": tmp_path / "a", "POCL_CACHE_DIR": tmp_path / "b"}
    for name, folder in caches.items():
        monkeypatch.setenv(name, str(folder))
    flags = {str(folder): SimpleNamespace(f_flag=os.ST_NOEXEC) for folder in caches.values()}
    monkeypatch.setattr(os, "statvfs", lambda p: flags.get(str(p), SimpleNamespace(f_flag=0)))
    with pytest.warns(UserWarning, match="is mounted noexec") as warned:
        drivers._give_cache()
    for name, warning in zip(caches, warned, strict=True):
        assert os.environ[name] in str(warning.message) and os.environ[name] != str(caches[name])


def test_a_device_without_room_for_constants_does_not_work():
    problem = find_problem(SimpleNamespace(max_constant_buffer_size=63))
    assert problem == "holds 63 bytes of constants, but needs 64"
