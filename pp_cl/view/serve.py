"""Starts and ends the viewer's server, in this process or beside a training."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import importlib.util
import os
import signal
import socket
import stat
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

from pp_cl.config import load_config
from pp_cl.device.discover import open_device
from pp_cl.errors import UserError
from pp_cl.files.run_folder import RunFolder
from pp_cl.run import check_scene
from pp_cl.view.access import Access
from pp_cl.view.live_run import LiveRun

GRACE_SECONDS = 10.0  # for a server in the background to end


def check_installed() -> None:
    """Raise UserError where the web framework is missing."""
    if importlib.util.find_spec("aiohttp") is None:
        raise UserError("pp-cl view needs aiohttp; install it with `pip install aiohttp`")


def serve(
    folder: Path | str,
    *,
    host: str,
    port: int,
    announce: Callable[[str], None],
    device: str | None = None,
    scene: str | None = None,
    wait: bool = False,
) -> None:
    """Show the run in a folder, or the scene, in the browser until Ctrl-C or a signal to terminate,
    which end it without an exception.

    port: 0 takes a free one. announce: called with the address once it listens. device: as `pp-cl
    devices` lists them. scene: where the run's scene is now. wait: for the folder to become a run,
    and end with the process that has started this one, if that keeps a pipe to its input. Raises
    UserError for a folder that is neither, and for a host or port that cannot be had.
    """
    check_installed()
    shown = None
    if not wait and not RunFolder(folder).config.exists() and Path(folder).is_dir():
        from pp_cl.view.scene_server import ShownScene

        if scene is not None:
            raise UserError("--scene: only of a run; leave it out")
        shown = ShownScene(Path(folder))
    elif not wait:
        load_config(RunFolder(folder).config)
    if scene is not None:
        check_scene(scene)
    with (
        contextlib.closing(_listen(host, port)) as listening,
        contextlib.suppress(KeyboardInterrupt),
    ):
        # asyncio ends its tasks one by one at Ctrl-C, which a job in the background ignores, and
        # knows no other signal
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGTERM, lambda *_: signal.raise_signal(signal.SIGINT))
        access = Access(host, listening.getsockname()[1])
        live = shown or LiveRun(open_device(device), folder, scene)
        asyncio.run(_serve(live, access, listening, announce=announce, wait=wait))


@contextlib.contextmanager
def serve_in_background(folder: Path | str, device: str | None = None) -> Iterator[None]:
    """Show a run that is about to be trained, in a process of its own, until the block ends.

    The process has its own device and reads the checkpoint file: the training's bits stay what they
    are. It prints the address and opens it. Raises UserError where the web framework is missing.
    """
    check_installed()
    words = [sys.executable, "-m", "pp_cl", "view", str(folder), "--wait", "--open", "--port", "0"]
    words += [] if device is None else ["--device", device]
    process = subprocess.Popen(words, stdin=subprocess.PIPE)
    try:
        yield
    finally:
        try:
            process.communicate(timeout=GRACE_SECONDS)  # the end of its input ends it
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _listen(host, port):
    """A socket that listens. Raises UserError in one line."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    both = host == "::" and socket.has_dualstack_ipv6()  # of IPv4 and IPv6
    try:
        return socket.create_server((host, port), family=family, dualstack_ipv6=both)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            line = f"--port {port}: another program uses it; choose another, or 0 for a free one"
        elif error.errno in (errno.EACCES, errno.EPERM):
            line = f"--port {port}: not allowed to this user; choose one above 1023"
        else:
            line = f"--host {host}: no address of this machine ({error.strerror})"
        raise UserError(line) from None


async def _serve(live, access, listening, *, announce, wait):
    """Serve a LiveRun or a ShownScene until cancelled, until drawing fails, which is a bug, or
    until a pipe to our input ends, if wait.
    """
    from aiohttp import web

    from pp_cl.view.scene_server import SceneServer
    from pp_cl.view.server import ViewServer

    server = (ViewServer if isinstance(live, LiveRun) else SceneServer)(live, access)
    runner = server.runner()
    await runner.setup()
    try:
        await web.SockSite(runner, listening).start()
        announce(access.address)
        ends: list[asyncio.Future[None]] = [asyncio.create_task(server.draw())]
        if wait and stat.S_ISFIFO(os.fstat(0).st_mode):
            ends.append(_input_ends())
        done, _ = await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
        done.pop().result()
    finally:
        await runner.cleanup()


def _input_ends():
    """A future that is done when our input ends; a daemon reads it, as no exit waits for these."""
    loop = asyncio.get_running_loop()
    ended = loop.create_future()

    def read():
        os.read(0, 1)
        with contextlib.suppress(RuntimeError):  # the loop has ended before
            loop.call_soon_threadsafe(ended.set_result, None)

    threading.Thread(target=read, daemon=True).start()
    return ended
