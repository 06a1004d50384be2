"""Who is let in."""

import pytest

from pp_cl.view.access import Access

HERE = Access("127.0.0.1", 8733, "secret")


def refusal(access=HERE, path="/secret/", host="127.0.0.1:8733", origin=None, strict=False):
    return access.refusal(path, host, origin, strict=strict)


def test_the_printed_address_is_let_in():
    assert HERE.address == "http://127.0.0.1:8733/secret/"
    for path in ("/secret/", "/secret/page.js", "/secret/socket"):
        assert refusal(path=path) is None
    assert refusal(host="localhost:8733") is None
    assert refusal(origin="http://127.0.0.1:8733", strict=True) is None


@pytest.mark.parametrize("path", ["/", "", "/secre/", "/secret2/", "//secret/", "/\u00e9/", "*"])
def test_no_or_another_token_is_refused(path):
    assert "token" in refusal(path=path)


@pytest.mark.parametrize(
    "host",
    [
        "",
        "127.0.0.1",
        "127.0.0.1:8734",
        "evil.example:8733",
        "127.0.0.1.evil.example:8733",
        "a@127.0.0.1:8733",
        "127.0.0.1:8733 x",
        "10.0.0.7:8733",
    ],
)
def test_another_host_is_refused(host):
    assert "Host" in refusal(host=host)


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "", "https://127.0.0.1:8733", "http://localhost:8733"]
)
def test_another_origin_is_refused(origin):
    assert "Origin" in refusal(origin=origin, strict=True)
    assert "Origin" in refusal(origin=origin)


def test_a_websocket_without_an_origin_is_refused():
    assert "Origin" in refusal(origin=None, strict=True)


def test_on_all_interfaces_numbers_are_let_in_and_names_are_not():
    everywhere = Access("0.0.0.0", 8733, "secret")  # noqa: S104
    assert everywhere.address == "http://127.0.0.1:8733/secret/"
    for host in ("192.168.1.5:8733", "[fe80::1]:8733", "localhost:8733"):
        assert refusal(everywhere, host=host) is None
    for host in ("evil.example:8733", "192.168.1.5:8734", "192.168.1.5"):
        assert "Host" in refusal(everywhere, host=host)


def test_on_all_of_ipv6_the_address_is_one_of_ipv6():
    everywhere = Access("::", 8733, "secret")
    assert everywhere.address == "http://[::1]:8733/secret/"
    assert refusal(everywhere, host="[::1]:8733", origin="http://[::1]:8733", strict=True) is None


def test_other_addresses_know_themselves_only():
    other = Access("::1", 8733, "secret")
    assert other.address == "http://[::1]:8733/secret/"
    assert refusal(other, host="[::1]:8733") is None
    assert "Host" in refusal(other, host="127.0.0.1:8733")
    assert refusal(Access("127.0.0.1", 80, "secret"), host="127.0.0.1") is None


def test_tokens_are_random_and_long():
    tokens = {Access("127.0.0.1", 1).token for _ in range(20)}
    assert len(tokens) == 20
    assert min(map(len, tokens)) >= 32


def test_headers_name_the_own_websocket_and_no_foreign_one():
    assert (
        "connect-src 'self' ws://127.0.0.1:8733;"
        in HERE.headers("127.0.0.1:8733")["Content-Security-Policy"]
    )
    assert "evil" not in str(HERE.headers("evil.example:8733"))
