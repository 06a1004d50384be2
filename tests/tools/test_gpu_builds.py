"""tools/gpu/builds.py: the stored list is what the drivers build on a GPU."""

import pytest

from pp_cl.device.compact import gather_rows
from pp_cl.device.device import kernel_folder
from pp_cl.device.discover import open_device
from pp_cl.device.signature import parse_signatures
from tools.gpu import builds
from tools.gpu.builds import Build, differences, main, read_builds, record, write_builds

CPU_FILES = {
    "layers/winograd",
    "layers/winograd_backward_weights",
    "layers/winograd_transform",
}
CPU_KERNELS = {("raster/pairs", "pairs_sort")}


@pytest.fixture(scope="module")
def device():
    """The device of PP_DEVICE, without guards."""
    return open_device().device


def gather(dev):
    """One program and one launch, as on a GPU."""
    assert not dev.is_cpu
    assert dev.info["type"] == "GPU"
    gather_rows(dev, dev.zeros((3, 4)), dev.upload([2, 0], "uint32"))


def with_a_new_set(dev):
    """The same, and a program that is built only."""
    gather(dev)
    dev.program("device/compact", WIDTH=4, A=1)


@pytest.mark.slow
def test_the_drivers_build_what_is_stored(device):
    assert differences(record(device), read_builds()) == []


def test_every_kernel_is_launched_but_those_for_cpus():
    launched = {(build.file, k) for build, kernels in read_builds().items() for k in kernels}
    missing = set()
    for path in sorted(kernel_folder().rglob("*.cl")):
        file = path.relative_to(kernel_folder()).with_suffix("").as_posix()
        kernels = parse_signatures(path.read_text("utf-8"), file)
        missing |= {(file, kernel) for kernel in kernels if (file, kernel) not in launched}
    assert {kernel for kernel in missing if kernel[0] not in CPU_FILES} == CPU_KERNELS
    assert {file for file, _ in missing - CPU_KERNELS} == CPU_FILES


def test_a_new_set_is_noticed(device, tmp_path, monkeypatch, capsys):
    file = tmp_path / "builds.json"
    monkeypatch.setattr(builds, "FILE", file)
    monkeypatch.setattr(builds, "run_all", gather)
    assert main(["--write"]) == 0
    assert read_builds(file) == {Build("device/compact", ("GROUP=1",)): {"gather_rows"}}
    assert main([]) == 0
    monkeypatch.setattr(builds, "run_all", with_a_new_set)
    assert main([]) == 1
    assert capsys.readouterr().err.splitlines()[0] == "new: device/compact A=1 WIDTH=4"
    assert main(["--write"]) == 0
    monkeypatch.setattr(builds, "run_all", gather)
    assert main([]) == 1
    assert capsys.readouterr().err.splitlines()[0] == "gone: device/compact A=1 WIDTH=4"


def test_a_kernel_that_is_launched_no_longer_is_noticed():
    build = Build("a/b", ("X=1",))
    assert differences({build: {"f"}}, {build: {"f", "g"}}) == ["gone: a/b X=1: g"]
    assert differences({build: {"f", "g"}}, {build: {"f"}}) == ["new: a/b X=1: g"]


def test_what_is_written_comes_back(tmp_path):
    some = {Build("a/b", ("X=1", "Y=2.0f")): {"f", "g"}, Build("a/b", ()): set()}
    write_builds(some, tmp_path / "b.json")
    assert read_builds(tmp_path / "b.json") == some
