"""`pp-cl view`: shows a run or a scene in the browser."""

import argparse
import html
import os
import sys
import tempfile
import threading
import webbrowser
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from pp_cl.commands import options as shared

HELP = "look at a run, also while it is trained, or at a scene in the browser"
EPILOG = """A scene: its cameras and sparse points. Its box can be moved and views dropped; both are
written to pp_cl.json in its folder, which training, info and all other commands obey."""
LOOPBACK = "127.0.0.1"
LOOPBACKS = (LOOPBACK, "localhost", "::1")
PORT = 8733


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add = parser.add_argument
    add("run_folder", metavar="RUN|SCENE", help="folder of a run, finished or not, or of a scene")
    add(
        "--port",
        type=shared.integer(0, 65535),
        default=PORT,
        metavar="P",
        help=f"port to listen on (default {PORT}; 0: any)",
    )
    add(
        "--host",
        default=LOOPBACK,
        metavar="H",
        help=f"address to listen on (default {LOOPBACK}: this machine only)",
    )
    add("--open", action="store_true", help="open the page in the default browser")
    add("--wait", action="store_true", help="wait for RUN to begin; end when a piped input ends")
    shared.add_run_scene(parser)
    shared.add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Serve until Ctrl-C."""
    from pp_cl.view.serve import serve

    if options.host not in LOOPBACKS:
        print(
            f"pp-cl: --host {options.host}: whoever can reach this address and learns the token can"
            " look on; nothing is encrypted",
            file=sys.stderr,
        )

    def announce(address):
        print(f"{options.run_folder}: {address}  (Ctrl-C ends)", flush=True)
        if options.open and _has_windows():
            file = stack.enter_context(_redirect(address))
            # some browsers answer only when they are closed, and must not keep the server waiting
            threading.Thread(target=webbrowser.open, args=(file.as_uri(),), daemon=True).start()

    with ExitStack() as stack:
        serve(
            options.run_folder,
            host=options.host,
            port=options.port,
            announce=announce,
            device=options.device,
            scene=options.scene,
            wait=options.wait,
        )


def _has_windows():
    """Whether a browser would answer that is not one for terminals."""
    windows = sys.platform in ("win32", "darwin")
    return windows or any(os.environ.get(n) for n in ("BROWSER", "DISPLAY", "WAYLAND_DISPLAY"))


@contextmanager
def _redirect(address) -> Iterator[Path]:
    """A page that leads to the address, for this user alone to read: everybody sees the arguments
    of a browser, and the address holds the token. It is there until the block ends. It lies in the
    user's home, where there is one: browsers in a sandbox (snap) see neither /tmp nor hidden files.
    """
    home = os.path.expanduser("~")  # which stays what it is without one
    there = home if os.access(home, os.W_OK) else None
    number, name = tempfile.mkstemp(".html", "pp-cl-view-", there)  # of mode 0600
    address = html.escape(address)
    with open(number, "w", encoding="utf-8") as file:
        file.write(
            f'<!DOCTYPE html><meta http-equiv="refresh" content="0;url={address}">'
            f'<a href="{address}">{address}</a>\n'
        )
    try:
        yield Path(name)
    finally:
        Path(name).unlink(missing_ok=True)
