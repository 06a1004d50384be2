"""A signal ends a process that runs pycolmap, whatever pycolmap does."""

import subprocess
import sys
from textwrap import dedent

import pytest

pytest.importorskip("pycolmap", reason="needs the extra `capture`")

LIMIT = 30  # seconds; a quiet machine takes less than one


@pytest.mark.unix
@pytest.mark.parametrize("number", [15, 2])
@pytest.mark.parametrize("where", ["isolated", "here"])
def test_a_signal_is_one_line_and_its_status(number, where):
    """Without care, pycolmap writes a stack trace on SIGTERM, and Ctrl-C waits until it is done."""
    work = "import time; print('begun', flush=True); time.sleep(600)"
    lines = f"""
        import sys
        from pathlib import Path
        from pp_cl.cli import program
        from pp_cl.commands import compare
        from pp_studio.capture.packages import isolated, needed

        def run(options):
            needed("pycolmap")
            if {where!r} == "here":
                exec({work!r})
            isolated(Path("."), exec, {work!r})

        if __name__ == "__main__":
            compare.run = run
            sys.exit(program(["compare", "a", "b"]))
    """
    command = [sys.executable, "-c", dedent(lines)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "begun\n"
        process.send_signal(number)
        try:
            _, errors = process.communicate(timeout=LIMIT)
        finally:
            process.kill()
    assert (process.returncode, errors) == (128 + number, "pp-cl: interrupted\n")
