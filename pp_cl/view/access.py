"""Access control of the viewer's server: every path begins with a token, which is checked before
anything else.

A page of another site can make a browser send requests here, and a name that its owner points at
127.0.0.1 makes them look like requests of the same site (DNS rebinding). Neither knows the token.
Host and Origin are not asked: behind ssh -L, JupyterHub or another proxy they are those of others.
"""

from __future__ import annotations

import hmac
import re
import secrets
import socket
from dataclasses import dataclass, field

ANY = ("0.0.0.0", "::")  # noqa: S104 compared with, not bound to
HOST = re.compile(r"[\w.:\[\]-]+")


@dataclass(frozen=True)
class Access:
    """host, port: what the server listens on. token: the first part of every path."""

    host: str
    port: int
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))

    @property
    def address(self) -> str:
        """What to open in a browser."""
        name = socket.gethostname() if self.host in ANY else self.host
        return f"http://{_bracketed(name)}:{self.port}/{self.token}/"

    def refusal(self, path: str) -> str | None:
        """Why a request of a decoded path is refused, one line, or None."""
        given = path.split("/", 2)[1] if path.startswith("/") else ""
        if not hmac.compare_digest(given.encode("utf-8", "replace"), self.token.encode()):
            return "the token is missing or wrong; open the address that pp-cl view printed"
        return None

    def headers(self, host: str) -> dict[str, str]:
        """Headers of every response. host: the request's."""
        # which 'self' does not mean in every browser
        own = f" ws://{host} wss://{host}" if HOST.fullmatch(host) else ""
        rules = (
            "default-src 'self'",
            "img-src 'self' blob:",
            f"connect-src 'self'{own}",
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


def _bracketed(name):
    return f"[{name}]" if ":" in name else name
