"""Who is let in."""

import socket

import pytest

from pp_cl.view.access import Access

HERE = Access("127.0.0.1", 8733, "secret")


def test_the_printed_address_is_let_in():
    assert HERE.address == "http://127.0.0.1:8733/secret/"
    for path in ("/secret/", "/secret/page.js", "/secret/socket"):
        assert HERE.refusal(path) is None


@pytest.mark.parametrize("path", ["/", "", "/secre/", "/secret2/", "//secret/", "/\u00e9/", "*"])
def test_no_or_another_token_is_refused(path):
    assert "token" in HERE.refusal(path)


@pytest.mark.parametrize("host", ["0.0.0.0", "::"])  # noqa: S104
def test_on_all_interfaces_the_address_is_one_that_others_can_open(host):
    assert Access(host, 8733, "secret").address == f"http://{socket.gethostname()}:8733/secret/"
    assert Access("::1", 8733, "secret").address == "http://[::1]:8733/secret/"


def test_tokens_are_random_and_long():
    tokens = {Access("127.0.0.1", 1).token for _ in range(20)}
    assert len(tokens) == 20
    assert min(map(len, tokens)) >= 32


def test_headers_name_the_own_websocket_and_nothing_that_breaks_them():
    """Behind a proxy the own name is another's."""
    rules = HERE.headers("hub.example")["Content-Security-Policy"]
    assert "connect-src 'self' ws://hub.example wss://hub.example;" in rules
    assert "evil" not in str(HERE.headers("a; script-src evil"))
