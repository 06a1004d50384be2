"""Run README.md's commands in an empty folder, on each OpenCL driver of this machine, and store the
output in docs/results/readme.json, from which `make docs` writes the lines of README.md.

    python -m tools.readme_lines        # or make readme; for minutes nothing else should run
"""

import json
import os
import re
import subprocess
import sys
import tempfile
from datetime import date

from pp_cl.drivers import list_devices
from pp_cl.files.atomic import write_json
from tools.provenance import ROOT, digest
from tools.results import RESULTS, WIDTHS, git, processor

FILE = RESULTS / "readme.json"
COMMANDS = re.compile(r"(?m)^    (pp-cl train demo [^\n]*)$|`(pp-cl eval runs/demo --metrics)`")
TRAINED = re.compile(
    r"^trained (?P<steps>\d+) steps in (?P<seconds>[\d.]+) s; (?P<points>\d+) points"
    r" \((?P<initial>\d+) at the start\); wrote runs/demo/checkpoint.npz$"
)
EVALUATED = re.compile(
    r"^runs/demo \(16 views\) +(?P<psnr>[\d.]+) +(?P<ssim>[\d.]+) +(?P<lpips>[\d.]+)$"
)


def commands() -> list[str]:
    """README's commands that train and evaluate the demo, word for word."""
    matches = COMMANDS.findall((ROOT / "README.md").read_text("utf-8"))
    return [train or evaluate for train, evaluate in matches]


def drivers() -> dict[str, int]:
    """{platform: floats in a vector} of the CPU devices that work."""
    devices = [device for _, device, problem in list_devices() if not problem]
    return {device.platform.name: device.native_vector_width_float for device in devices}


def machine() -> str:
    """The number of cores and the name of this processor."""
    return f"{os.cpu_count()} cores of {processor()}"


def typed(driver: str) -> list[str]:
    """The lines that README's commands print on a driver, in an empty folder."""
    lines = []
    environment = os.environ | {"PP_DEVICE": driver, "PYTHONPATH": str(ROOT)}
    with tempfile.TemporaryDirectory() as folder:
        for command in commands():
            words = [sys.executable, "-m", "pp_cl", *command.split()[1:]]
            done = subprocess.run(
                words, cwd=folder, env=environment, check=True, stdout=subprocess.PIPE, text=True
            )
            lines += done.stdout.splitlines()
    return lines


def row(driver: str, width: int) -> dict:
    """The lines and numbers that README shows for a driver."""
    lines = typed(driver)
    numbers = {}
    for form in (TRAINED, EVALUATED):
        [match] = filter(None, map(form.match, lines))
        numbers |= match.groupdict()
    head = next(line for line in lines if line.split() == ["psnr", "ssim", "lpips"])
    shown = [head, next(line for line in lines if EVALUATED.match(line))]
    trained = next(line for line in lines if TRAINED.match(line))
    return {"driver": driver, "kind": WIDTHS[width], **numbers, "trained": trained, "table": shown}


def main() -> int:
    """Measure on every driver and store the rows; returns the exit status."""
    rows = [row(driver, width) for driver, width in drivers().items()]
    # Intel's first: README's own install line installs it
    rows.sort(key=lambda measured: "Intel" not in measured["driver"])
    about = {
        "commit": git("log", "-1", "--format=%h"),
        "date": date.today().isoformat(),
        "machine": machine(),
        "decides": digest(),
    }
    write_json(FILE, about | {"rows": rows})
    print(json.dumps(rows, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
