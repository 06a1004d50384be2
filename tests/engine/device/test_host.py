import mmap
from types import SimpleNamespace

import numpy as np
import pytest

from pp_cl.drivers import open_device
from pp_cl.engine.device import host
from pp_cl.engine.device.device import Device

MIB = 2**20


@pytest.fixture
def group(tmp_path, monkeypatch):
    """A container for this process, which holds 40 MiB, on a machine with 1000 MiB free."""
    monkeypatch.setattr(host, "GROUP", tmp_path)
    free, held = SimpleNamespace(available=1000 * MIB), SimpleNamespace(rss=40 * MIB)
    monkeypatch.setattr("psutil.virtual_memory", lambda: free)
    monkeypatch.setattr("psutil.Process.memory_info", lambda process: held)
    return tmp_path


def limit(group, most, used, cached):
    (group / "memory.max").write_text(f"{most}\n")
    (group / "memory.current").write_text(f"{used}\n")
    (group / "memory.stat").write_text(f"anon 5\ninactive_file {cached}\n")


def test_a_container_has_less(group):
    assert host.resident_bytes() == 40 * MIB
    assert host.available_bytes() == 1040 * MIB
    limit(group, 500 * MIB, 300 * MIB, 30 * MIB)
    assert host.available_bytes() == 270 * MIB
    limit(group, 5000 * MIB, 300 * MIB, 0)
    assert host.available_bytes() == 1040 * MIB
    limit(group, "max", 300 * MIB, 0)
    assert host.available_bytes() == 1040 * MIB
    limit(group, 500 * MIB, "many", 0)
    assert host.available_bytes() == 1040 * MIB


def test_this_machine():
    before = host.resident_bytes()
    block = np.frombuffer(mmap.mmap(-1, 256 * MIB), np.uint8)  # fresh, not memory that malloc kept
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
