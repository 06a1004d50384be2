import mmap

import numpy as np
import pytest

from pp_cl.drivers import open_device
from pp_cl.engine.device import host
from pp_cl.engine.device.device import Device

MIB = 2**20


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """A machine with 1000 MiB free, on which this process holds 40 pages."""
    monkeypatch.setattr(host, "PROC", tmp_path)
    monkeypatch.setattr(host, "GROUP", tmp_path / "group")
    monkeypatch.setattr("os.sysconf", lambda name: 4096)
    (tmp_path / "self").mkdir()
    (tmp_path / "self/statm").write_text("900 40 30 1 0 20 0\n")
    (tmp_path / "meminfo").write_text("MemTotal:  9000 kB\nMemAvailable:  1024000 kB\n")
    (tmp_path / "group").mkdir()
    return tmp_path


def limit(machine, most, used, cached):
    (machine / "group/memory.max").write_text(f"{most}\n")
    (machine / "group/memory.current").write_text(f"{used}\n")
    (machine / "group/memory.stat").write_text(f"anon 5\ninactive_file {cached}\n")


def test_a_container_has_less(machine):
    assert host.resident_bytes() == 40 * 4096
    assert host.available_bytes() == 1000 * MIB + 40 * 4096
    limit(machine, 500 * MIB, 300 * MIB, 30 * MIB)
    assert host.available_bytes() == 230 * MIB + 40 * 4096
    limit(machine, 5000 * MIB, 300 * MIB, 0)
    assert host.available_bytes() == 1000 * MIB + 40 * 4096
    limit(machine, "max", 300 * MIB, 0)
    assert host.available_bytes() == 1000 * MIB + 40 * 4096


@pytest.mark.parametrize("text", [None, "", "MemTotal: 9 kB\n", "MemAvailable: many\n"])
def test_a_system_that_does_not_tell(machine, text):
    (machine / "meminfo").unlink()
    if text is not None:
        (machine / "meminfo").write_text(text)
    assert host.available_bytes() is None
    (machine / "self/statm").unlink()
    assert host.resident_bytes() == 0


@pytest.mark.skipif(not host.PROC.is_dir(), reason="no /proc")
def test_this_machine():
    before = host.resident_bytes()
    block = np.frombuffer(mmap.mmap(-1, 256 * MIB), np.uint8)  # not what malloc has kept
    block[:] = 1
    grown = host.resident_bytes() - before
    assert 0.9 * block.nbytes < grown < 1.2 * block.nbytes
    assert host.available_bytes() > host.resident_bytes()


def test_large_buffers_of_a_cpu_ask_for_huge_pages(monkeypatch):
    asked = []
    monkeypatch.setattr(
        "pp_cl.engine.device.device.ask_for_huge_pages", lambda *place: asked.append(place)
    )
    dev = Device(open_device().device)  # without guards
    held = [dev.empty((size,), np.uint8) for size in (MIB, 64 * MIB)]
    assert [nbytes for _, nbytes in asked] == [64 * MIB] * dev.is_cpu
    assert all(place for place, _ in asked), held
