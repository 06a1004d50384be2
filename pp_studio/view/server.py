"""Starts the viewer's web server, viser, quietly on one address."""

import html
import io
import json
import logging
import socket
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from typing import Any

from pp_cl.errors import UserError

LOOPBACK, PORT = "127.0.0.1", 8733
ANY = ("0.0.0.0", "::")  # noqa: S104 compared with, not bound to


@contextmanager
def started(label: str, host: str = LOOPBACK, port: int | None = None) -> Iterator[tuple[Any, str]]:
    """(viser's server with an empty page, the address to open in a browser) until the block ends.
    label: title of the page's panel and of its tab in the browser. port: 0: any free port; None:
    the first free one from PORT on. Raises UserError if host or port is not available.
    """
    import viser

    if port is not None:  # viser would try other ports, forever if the host is wrong
        try:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            with socket.create_server((host, port), family=family) as tried:
                port = tried.getsockname()[1]
        except OSError as error:
            reason = str(error.strerror).partition(" (")[0]
            raise UserError(f"--host {host} --port {port}: {reason}; give another") from None
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)  # broken requests
    warnings.filterwarnings("ignore", "Queued a .* on a closed connection")  # a tab just closed
    with redirect_stdout(io.StringIO()):
        server: Any = viser.ViserServer(host, PORT if port is None else port, label, verbose=False)
    # otherwise a tab could have the server published through a machine of viser's authors
    server.request_share_url = lambda verbose=True: None
    name = socket.gethostname() if host in ANY else host
    try:
        server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        server.gui.main_panel.float(x=15, y=-15)
        # viser offers no other way to set the title of the browser's tab
        script = html.escape(f"document.title = {json.dumps(label)}")
        server.gui.add_html(f'<img hidden src="data:," onerror="{script}">')
        yield server, f"http://{f'[{name}]' if ':' in name else name}:{server.get_port()}"
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()


def plain(text: str) -> str:
    """Text of others, such as a file's name, for viser's Markdown, which renders HTML in it."""
    return html.escape(text, quote=False).replace("[", r"\[")


def switches(server: Any) -> Any:
    """A context in which anything added to server.gui goes into a panel of its own, beside that of
    the page's lines; on a phone, where it would cover the picture, it starts closed.
    """
    panel = server.gui.add_panel()
    panel.dock_right()
    return panel.add_tab("Display")
