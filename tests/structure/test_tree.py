"""Who has found one file of a stage has found all three."""

from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_every_kernel_file_has_its_module_and_its_test():
    files, missing = sorted((ROOT / "cl").rglob("*.cl")), []
    for path in files:
        stem = path.relative_to(ROOT / "cl").with_suffix("")
        for other in (f"pp_cl/{stem}.py", f"tests/{stem.parent}/test_{stem.name}.py"):
            missing += [] if (ROOT / other).is_file() else [f"{stem}.cl: no {other}"]
    assert files
    assert not missing
