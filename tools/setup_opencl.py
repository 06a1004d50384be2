"""Makes sure that this virtual environment has a working OpenCL device; `make setup` runs it.

A device works if a test build runs on it. Tried in turn until one works: the devices already here,
Debian's PoCL (as root), Intel's CPU runtime (x86-64). With --intel: Intel's runtime, even if other
devices work.
"""

import argparse
import os
import platform
import shutil
import subprocess
import sys


def devices():
    """The lines of `pp-cl devices`, which also measures which device is the fastest."""
    command = [sys.executable, "-m", "pp_cl", "devices"]
    listed = subprocess.run(command, capture_output=True, text=True)
    if listed.returncode not in (0, 2):  # 2: no device works
        print(
            f"asking for the devices ended with status {listed.returncode}:"
            f" {listed.stderr.strip()}",
            file=sys.stderr,
        )
    return listed.stdout.splitlines()


def works(lines, name=""):
    """Whether a device whose line contains `name` works."""
    return any(": works" in line and name in line for line in lines)


def install_debian():
    """Debian's and Ubuntu's PoCL."""
    env = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    for command in ("update", "install --yes --no-install-recommends pocl-opencl-icd"):
        subprocess.run(
            [shutil.which("apt-get"), "-qq", *command.split()],
            env=env,
            stdout=subprocess.DEVNULL,
            check=True,
        )


def install_intel():
    """Intel's CPU runtime, inside the virtual environment, where pp-cl finds it."""
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    subprocess.run([*pip, "install", "--editable", ".[cpu]"], check=True)


def main():
    """Returns the exit status: 0 if a device works at the end, else 1."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--intel", action="store_true", help="install Intel's CPU runtime, whatever else is there"
    )
    only_intel = parser.parse_args().intel
    wanted = "Intel(R) OpenCL" if only_intel else ""

    steps = []
    if os.geteuid() == 0 and shutil.which("apt-get") and not only_intel:
        steps.append(install_debian)
    if platform.machine() == "x86_64":
        steps.append(install_intel)

    lines = devices()
    for step in steps:
        if works(lines, wanted):
            break
        print(f"no working OpenCL device yet; trying: {step.__doc__.splitlines()[0]}", flush=True)
        try:
            step()
        except subprocess.CalledProcessError as error:
            print(f"  that did not work: {error}", file=sys.stderr)
        lines = devices()
    print("\n".join(lines) or "no OpenCL device found")
    if works(lines, wanted):
        return 0
    print("no working OpenCL device: docs/install.md says how to install one", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
