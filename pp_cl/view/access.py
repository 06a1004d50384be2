"""Access control of the viewer's server: token, Host and Origin are checked before anything else.

A page of another site can make a browser send requests here, and a name that its owner points at
127.0.0.1 makes them look like requests of the same site (DNS rebinding). Such requests lack the
token, and carry that other name as Host or Origin.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
from dataclasses import dataclass, field

LOOPBACK = ("127.0.0.1", "localhost")
ANY = ("0.0.0.0", "::")  # noqa: S104 compared with, not bound to
HTTP_PORT = 80  # which browsers leave out of Host


@dataclass(frozen=True)
class Access:
    """host, port: what the server listens on. token: the first part of every path."""

    host: str
    port: int
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))

    @property
    def address(self) -> str:
        """What to open in a browser."""
        # a socket of `::` takes no IPv4
        name = {"0.0.0.0": LOOPBACK[0], "::": "::1"}.get(self.host, self.host)  # noqa: S104
        return f"http://{_bracketed(name)}:{self.port}/{self.token}/"

    def refusal(self, path: str, host: str, origin: str | None, *, strict: bool) -> str | None:
        """Why a request is refused, one line, or None. path: decoded; host, origin: the headers;
        strict: whether it must have an Origin, as browsers send it for websockets and for what
        changes something.
        """
        if not self._knows(host):
            return "Host is not the address of this server"
        given = path.split("/", 2)[1] if path.startswith("/") else ""
        if not hmac.compare_digest(given.encode("utf-8", "replace"), self.token.encode()):
            return "the token is missing or wrong; open the address that pp-cl view printed"
        if (strict or origin is not None) and origin != f"http://{host}":
            return "Origin is not the address of this server"
        return None

    def headers(self, host: str) -> dict[str, str]:
        """Headers of every response. host: the request's."""
        socket = f" ws://{host}" if self._knows(host) else ""
        rules = (
            "default-src 'self'",
            "img-src 'self' blob:",
            f"connect-src 'self'{socket}",
            "object-src 'none'",
            "base-uri 'none'",
            "form-action 'none'",
            "frame-ancestors 'none'",
        )
        return {
            "Content-Security-Policy": "; ".join(rules),
            "Cross-Origin-Resource-Policy": "same-origin",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "Cache-Control": "no-store",
            "Server": "pp-cl",
        }

    def _knows(self, host):
        """Whether a Host header names this server. On all interfaces any number is an address of
        it, since only names can be rebound.
        """
        if host in self._hosts([self.host, *LOOPBACK] if self._is_local else [self.host]):
            return True
        name, _, port = host.rpartition(":")
        return self.host in ANY and port == str(self.port) and _is_number(name.strip("[]"))

    @property
    def _is_local(self):
        return self.host in (*LOOPBACK, *ANY)

    def _hosts(self, names):
        hosts = {f"{_bracketed(name)}:{self.port}" for name in names}
        return hosts | {_bracketed(name) for name in names if self.port == HTTP_PORT}


def _bracketed(name):
    return f"[{name}]" if ":" in name else name


def _is_number(name):
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
