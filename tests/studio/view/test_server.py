import json
import logging
import socket
import urllib.request
import warnings
from urllib.error import URLError

import pytest
import websockets.exceptions
from support.viewing import SECONDS, tab

from pp_studio.view.server import started


def test_it_listens_on_loopback_alone_and_goes_when_the_block_ends(capfd):
    with started("a name", port=0) as (server, address):
        assert address == f"http://127.0.0.1:{server.get_port()}"
        with urllib.request.urlopen(address, timeout=SECONDS) as page:  # noqa: S310
            assert page.status == 200
        here = socket.gethostbyname(socket.gethostname())
        if not here.startswith("127."):
            with pytest.raises(OSError, match="refused"):
                socket.create_connection((here, server.get_port()), SECONDS)
    with pytest.raises(URLError):
        urllib.request.urlopen(address, timeout=SECONDS)  # noqa: S310
    assert "".join(capfd.readouterr()) == ""


def test_a_training_takes_the_next_free_port(monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        monkeypatch.setattr("pp_studio.view.server.PORT", port)
        with started("a") as (server, _):
            assert server.get_port() > port


def test_a_tab_cannot_have_it_published(served, monkeypatch):
    """viser would ask a server on the internet to let strangers in."""
    asked = []
    monkeypatch.setattr("viser._viser.ViserTunnel", lambda *place: asked.append(place))
    server, address = served
    with tab(address) as opened:
        opened.send("ShareUrlRequest")
        server.gui.add_button("pressed").on_click(lambda _: server.gui.add_markdown("a line"))
        opened.receive("GuiButtonMessage")
        opened.set("pressed", True)  # its answer comes after that of the request
        opened.receive("GuiMarkdownMessage")
    assert not asked


def test_broken_requests_leave_no_traceback(served, capfd, caplog):
    caplog.set_level(logging.DEBUG)
    for junk in (b"GET / HTTP/9.9\r\n\r\n", b"\x16\x03\x01\r\n\r\n", b"GET /" + b"a" * 9999):
        with socket.create_connection(("127.0.0.1", served[0].get_port()), SECONDS) as stream:
            stream.sendall(junk)
    with tab(served[1]) as opened:
        opened._socket.send(json.dumps({"type": "x"}))  # a text, not binary
        with pytest.raises(websockets.exceptions.ConnectionClosed):
            opened.receive("never")
    with warnings.catch_warnings(record=True) as caught, tab(served[1]):
        pass
    assert not caught and "".join(capfd.readouterr()) == ""
    assert not [r for r in caplog.records if r.exc_info and r.name != "websockets.client"]
