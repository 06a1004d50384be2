"""`pp-cl view`: shows a run or a scene in the browser."""

import argparse
import os
import sys
import threading
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from pp_cl.commands import options as shared
from pp_studio.view.server import LOOPBACK, PORT

if TYPE_CHECKING:
    from pp_cl import OnStep, Training

HELP = "look at a run, also while it is trained, or at a scene in the browser"
EPILOG = """A scene: its cameras, and sparse points or visual hull. Its box can be moved and views
dropped; both are written to pp_cl.json in its folder, which training, info and all other commands
obey. Whoever reaches the port sees and steers the page."""
LOOPBACKS = (LOOPBACK, "localhost", "::1")
BROWSERS = ("BROWSER", "DISPLAY", "WAYLAND_DISPLAY")  # with none set, a terminal browser would open


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
    shared.add_run_scene(parser)
    shared.add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Serve until Ctrl-C."""
    from pp_cl import find_run, open_device, stored_config
    from pp_cl.errors import name_of, require
    from pp_cl.scene import scene_splits
    from pp_studio.view.run_view import RunView
    from pp_studio.view.scene_page import ScenePage
    from pp_studio.view.server import started

    require("the viewer", "viser")
    run, scene = find_run(options.run_folder), options.scene
    folder = run.path
    is_scene = folder.is_dir() and not run.config.exists()
    if is_scene:
        shared.refuse(options, ("scene",), "only of a run")
        scene_splits(folder)
    else:
        stored_config(run, scene)
    if options.host not in LOOPBACKS:
        print(
            f"pp-cl: --host {options.host}: whoever can reach this address sees the viewer and"
            " steers it; nothing is encrypted",
            file=sys.stderr,
        )
    with started(name_of(folder) if is_scene else run.name, options.host, options.port) as (
        server,
        address,
    ):
        view: ScenePage | RunView
        if is_scene:
            view = ScenePage(server, folder, options.device)
        else:
            dev = open_device(options.device)
            view = RunView(server, dev, run, scene)
        print(f"{options.run_folder}: {address}  (Ctrl-C ends)", flush=True)
        if options.open:
            open_browser(address)
        view.serve()


@contextmanager
def following(training: "Training") -> Iterator["OnStep"]:
    """Show a training in the browser during the block; yields its OnStep."""
    from pp_studio.view.run_view import shown_training

    with shown_training(training) as (address, show):
        print(f"watch at {address}", flush=True)
        open_browser(address)
        yield show


def open_browser(address: str) -> None:
    """Open an address in a graphical browser, if there is one."""
    if sys.platform in ("win32", "darwin") or any(name in os.environ for name in BROWSERS):
        # some browsers return only when closed; the server must not wait for them
        threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()
